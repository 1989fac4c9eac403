"""Command line: each command's module parses arguments, calls the study and prints."""
