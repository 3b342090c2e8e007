"""The ground floor: 3x3 algebra, rotations, regions, neighbours, patches and the frame of a simulation."""
