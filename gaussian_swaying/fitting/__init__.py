"""Find the wind and the material from video: what is sought, videos, tracks, batches of simulations, least squares."""
