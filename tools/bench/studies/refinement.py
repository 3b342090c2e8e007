"""Flags beside the motions of Blender's cloth on finer and finer grids, and the plot of their distances."""

from __future__ import annotations

from bench.runner import ROOT, Row, read, study
from bench.studies.flags import FLAGS, arguments, compared


@study("refinement", [{"flag": flag, "cells": cells} for flag in FLAGS for cells in (20, 30, 40, 60, 80)])
def refinement(flag: str, cells: int, device: str) -> Row:
    """The first 100 frames of a flag on a grid with so many cells along its longer side, in the linear law."""
    longer = {"3": 2.0, "4": 1.4, "curtain": 1.4, "pennant": 1.6}.get(flag, 1.2)
    dx = longer / cells
    words = [*arguments(flag, "made", "ours"), f"--solver.dx={dx}", f"--scene.particle_spacing={0.45 * dx}"]
    found = compared([*words, "--aero.law=linear"], flag, device, 100)
    return {"chamfer": found["chamfer_share"], "points": found["particles"]}


def plot() -> None:
    """Draw ``refinement.png``."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.5, 4), layout="constrained")
    for flag in FLAGS:
        runs = [run for run in read("refinement") if str(run.flag) == flag and hasattr(run, "cells")]
        runs.sort(key=lambda run: run.cells)
        axis.plot([run.cells for run in runs], [100 * run.chamfer for run in runs], "o-", label=flag)
    axis.set(xlabel="cells along the longer side", ylabel="distance [% of the longer side]", ylim=(0, None))
    axis.legend(fontsize=8)
    figure.savefig(ROOT / "docs" / "pictures" / "refinement.png", dpi=110)
