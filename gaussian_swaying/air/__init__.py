"""Computed air: a lattice Boltzmann flow in a box, and how thin surfaces and the flow push each other."""
