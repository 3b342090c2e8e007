"""Preview of a splat: its properties, a suggested first configuration, its cost and a picture."""
