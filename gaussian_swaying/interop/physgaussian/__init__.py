"""PhysGaussian's configurations, space and camera."""
