"""What a splat looks like to a run, and its first configuration."""
