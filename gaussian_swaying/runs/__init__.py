"""The folder of a run: locked by one process, files with checksums, and signals that end a run in order."""
