"""Surface-aligned Gaussians from photos: data, losses, densification and the Lightning module."""
