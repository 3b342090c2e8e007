"""Training data: images and their order."""
