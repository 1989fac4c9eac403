"""The subcommands of `impc`: each parses, calls and prints; no mathematics."""
