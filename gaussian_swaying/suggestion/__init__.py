"""A first simulation of a captured splat: guesses with their reasons, a picture and a configuration."""
