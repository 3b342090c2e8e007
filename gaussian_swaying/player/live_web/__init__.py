"""A simulation that runs in a browser, in one file without a server."""
