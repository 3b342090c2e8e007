"""The folder of a run: locked by one process, files of tensors, and signals that end a run in order."""
