"""Distances between a run and a reference: structural similarity, Chamfer and Fréchet video distance."""
