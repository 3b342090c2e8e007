"""Cameras and their paths."""
