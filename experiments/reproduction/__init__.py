"""The reproduction table: every equation, table, figure and claim of the dissertation."""
