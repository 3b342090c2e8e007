"""A live wind tunnel: a simulation that goes on while its wind and material are changed, on a local page."""
