"""Cameras, shading and renderers."""
