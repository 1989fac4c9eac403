"""Studies and benchmarks of the package; README.md lists questions, commands and answers."""
