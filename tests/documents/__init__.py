"""Every block of code in the README and the pages of `docs`, run as a reader would run it."""
