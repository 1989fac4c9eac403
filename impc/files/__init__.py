"""Recordings in files: tables of any format, what their columns mean, checks, resampling."""
