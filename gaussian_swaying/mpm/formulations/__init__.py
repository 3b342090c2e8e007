"""The formulations of the substep in torch, one file each, with all that they need at rest."""
