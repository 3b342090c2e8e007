"""Turns YAML files and the command line into settings."""
