"""Writing and reading the files of a run: frames, splats, trajectory, checkpoint."""
