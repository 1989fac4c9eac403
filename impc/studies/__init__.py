"""Studies: methods and assessments applied to recordings, with their reports."""
