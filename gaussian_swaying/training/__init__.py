"""Surface-aligned Gaussians from photos: losses, densification, the Lightning module and its command line."""
