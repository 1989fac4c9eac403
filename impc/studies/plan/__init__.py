"""Before anyone is measured: what a planned experiment would identify of a presumed person."""
