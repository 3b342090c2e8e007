"""The scene as Gaussians: files, harmonics, regions, surface patches."""
