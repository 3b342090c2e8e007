"""Comparison of a run with a reference."""
