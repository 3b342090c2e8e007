"""Wind on captured 3D Gaussian scenes."""
