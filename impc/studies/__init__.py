"""Studies are compositions: methods and assessments on recordings, with their pages."""
