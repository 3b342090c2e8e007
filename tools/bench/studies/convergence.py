"""Error against cells of problems with an exact solution, and the plot of it."""

from __future__ import annotations

from functools import partial
from typing import Any

from bench.known import AT_POINTS, VARIANTS
from bench.problems import bars, vortex
from bench.runner import ROOT, Row, read, study

PANELS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "confined bar (frequency)": (bars.vibrating_bar, (8, 16, 32, 64)),
    "bar held at points (frequency)": (AT_POINTS, (8, 16, 32, 64)),
    "bar held by nodes (frequency)": (partial(bars.vibrating_bar, ends="fixed-free"), (8, 16, 32, 64)),
    "hanging bar (tip)": (bars.hanging_bar, (8, 16, 32)),
    "vortex (displacement)": (vortex.vortex, (16, 24, 32)),
}


GRID = [
    {"problem": problem, "variant": variant, "cells": cells}
    for problem, (_, grids) in PANELS.items()
    for variant in VARIANTS
    for cells in grids
]


@study("convergence", GRID)
def convergence(problem: str, variant: str, cells: int) -> Row:
    """The relative error on one grid."""
    return {"error": PANELS[problem][0](cells, VARIANTS[variant])["error"]}


def plot() -> None:
    """Draw ``convergence.png``."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(PANELS), figsize=(16, 3.4), layout="constrained")
    for axis, problem in zip(axes, PANELS, strict=True):
        for variant, marker in zip(VARIANTS, "os.", strict=True):
            runs = [run for run in read("convergence") if (run.problem, run.variant) == (problem, variant)]
            axis.loglog([run.cells for run in runs], [run.error for run in runs], f"{marker}-", label=variant)
        axis.set(title=problem, xlabel="cells", ylabel="relative error")
    axes[0].legend(fontsize=8)
    figure.savefig(ROOT / "docs" / "pictures" / "convergence.png", dpi=110)
