"""Films of runs for the web: one file that a browser plays without a server."""
