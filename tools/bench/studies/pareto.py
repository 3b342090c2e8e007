"""Speed against error of a bar, a cantilever, a hinged plate and a flag, and the plot of it."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import torch
from torch import Tensor

from bench.problems import bars, beams, flags, plates
from bench.problems.settings import Settings
from bench.runner import ROOT, Row, read, study

SIZES: dict[str, tuple[float, ...]] = {
    "bar": (8, 16, 32, 64), "cantilever": (1, 2, 3, 4), "hinged plate": (4, 6, 8, 12),
    "flag": (0.16, 0.08, 0.0533, 0.04),
}  # fmt: skip
"""Cells along the bar and the plate and through the thickness of the beam, and dx of the flag [m]."""
FLAG: dict[str, Any] = {"frames": 15, "spacing": 0.02}
PROVEN = 0.47
"""Largest CFL that is stable for any arrangement of points (mpm/timestep.py)."""


@cache
def reference(device: str) -> Tensor:
    """The flag on a fine grid with short substeps."""
    return flags.flag(0.0267, Settings(cfl=0.1, device=device), **FLAG)[1]


@study("pareto", [{"problem": problem, "size": size, "formulation": formulation, "cfl": cfl}
                  for problem, sizes in SIZES.items() for size in sizes
                  for formulation, cfl in product(("total", "updated"), (0.2, 0.4, 0.8))])  # fmt: skip
def pareto(problem: str, size: float, formulation: str, cfl: float, device: str) -> Row:
    """Error (of the plate in degrees) and time per simulated second, in float32."""
    settings = Settings(formulation=formulation, cfl=cfl, dtype=torch.float32, device=device)
    if problem == "bar":
        found = bars.vibrating_bar(int(size), settings)
    elif problem == "cantilever":
        found = beams.cantilever(int(size), settings, slenderness=6)
    elif problem == "hinged plate":
        found = plates.hinged_plate(0.5, "projected", settings, cells=int(size), seconds=2.4, per_cell=3)
    else:
        found, series = flags.flag(size, settings, **FLAG)
        found |= {"error": flags.distance(series, reference(device))}
    return {"error": abs(found["error"]), "wall_per_simulated_s": found["wall_s"] / found["simulated_s"]}


def plot(kind: str = "cpu") -> None:
    """Draw ``pareto_cpu.png``: solid points have a proven substep, the line is their front, stars are the default."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for axis, problem in zip(axes.flat, SIZES, strict=True):
        runs = [run for run in read("pareto") if run.problem == problem and ("CPU" in run.device) == (kind == "cpu")]
        for run in runs:
            color = "tab:blue" if run.formulation == "total" else "tab:orange"
            face = color if run.cfl <= PROVEN else "none"
            axis.loglog(run.wall_per_simulated_s, run.error, "o", color=color, markerfacecolor=face)
            if (run.formulation, run.cfl) == ("total", 0.4):
                axis.loglog(run.wall_per_simulated_s, run.error, "k*", markersize=9)
        best: list[Any] = []
        for run in sorted(runs, key=lambda run: run.wall_per_simulated_s):
            if run.cfl <= PROVEN and (not best or run.error < best[-1].error):
                best.append(run)
        axis.loglog([run.wall_per_simulated_s for run in best], [run.error for run in best], "k-", linewidth=0.8)
        axis.set(title=problem, xlabel="seconds per simulated second", ylabel="error")
    figure.savefig(ROOT / "docs" / "pictures" / f"pareto_{kind}.png", dpi=110)
