"""Distances between a run and a reference: structural similarity and nearest points."""
