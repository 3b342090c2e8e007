"""Distances between a run and a reference: structural similarity, nearest points, Fréchet video distance."""
