"""Pages that show Gaussians in a browser: a live wind tunnel, and films of runs."""
