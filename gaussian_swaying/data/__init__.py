"""Scenes made in code and readers of other people's data."""
