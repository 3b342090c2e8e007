"""Pages that show Gaussians in a browser."""
