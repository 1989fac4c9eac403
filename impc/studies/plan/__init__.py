"""Before anyone is measured: what a planned experiment would tell of a presumed person."""
