"""Find the wind and the material from video: unknowns, videos, tracks, batches of simulations, least squares."""
