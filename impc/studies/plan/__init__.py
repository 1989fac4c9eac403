"""Before anyone is measured: what a planned experiment would say of a presumed person."""
