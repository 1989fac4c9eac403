"""`impc app`: recordings, questions, fits and reports in a browser on the same machine."""
