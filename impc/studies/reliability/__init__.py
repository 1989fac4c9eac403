"""Reliability of the seated-balance test (chapter 2 of the dissertation)."""
