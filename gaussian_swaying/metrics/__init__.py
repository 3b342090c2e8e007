"""How far a run is from a reference: structural similarity, Chamfer and Fréchet video distance."""
