"""Geometry that all other folders use: 3x3 algebra, rotations, regions, neighbours, patches, the simulation's frame."""
