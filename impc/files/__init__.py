"""Recordings in files: reading of all formats, configuration, checks, resampling."""
