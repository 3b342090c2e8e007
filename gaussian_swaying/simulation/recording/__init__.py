"""What a run writes and reads again: frames, splats, trajectory, checkpoint."""
