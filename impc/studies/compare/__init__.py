"""Every method on the same trials."""
