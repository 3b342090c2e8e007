"""From a scene and its settings to recorded frames."""
