"""Comparison of a run with a reference, and measures of motion."""
