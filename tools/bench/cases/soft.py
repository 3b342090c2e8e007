"""``bench.py soft``: a soft body by Newton: our motion at the true values beside Newton's, and what fits find.

``tools/datasets/make_fit_data.py --case soft`` makes the data.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.case import UNTIL, Case, Measurement, option
from bench.cases.fit import blender_rows, fit_row
from bench.cases.fit_reference import plan_of, simulation_of
from bench.record import ROOT, Row
from gaussian_swaying.fitting.plan import Plan

sys.path.append(str(ROOT / "tools" / "datasets"))  # scripts that import each other from their own folder

from soft_case import compared

ROWS = ("two cameras", "one camera")


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The motion at the true values, and the fits."""
    folder, known = options.data, json.loads(options.known)
    plan, truth = plan_of(folder, known, options.until, options.search)
    if (folder / "uncertainty.json").exists():
        result["reference"] = json.loads((folder / "uncertainty.json").read_text())["variants"]
    wanted = options.row or ("motion", *ROWS)
    if "motion" in wanted:
        name = ", ".join(f"`{key}` {value}" for key, value in known.items()) or "as in `scene.yaml`"
        yield ("motion", name), partial(motion, plan, folder / "gaussians.npz", truth, options.device)
    true, more = {"flow": truth["flow"], "material.E": truth["E"]}, {"known": known, "until_s": plan.until}
    with tempfile.TemporaryDirectory() as scratch:
        for name in (row for row in ROWS if row in wanted):
            changed = replace(plan, **blender_rows(known, truth)[name])
            yield ("fits", name), partial(fit_row, changed, Path(scratch) / name, options.device, true, more)


def motion(plan: Plan, gaussians: Path, truth: Mapping[str, Any], device: str) -> Row:
    """The simulation at the true values beside the true motion of each Gaussian; lengths in metres."""
    true_values = {"wind.flow": truth["flow"], "material.E": truth["E"]}
    simulation = simulation_of(replace(plan, known={**plan.known, **true_values}), device)
    with np.load(gaussians) as file:
        true = file["positions"].astype(np.float64)
    begin = time.perf_counter()
    ours = np.stack([f.gaussians.means.cpu().double().numpy() for f in simulation.frames(len(true))])
    return compared(ours, true, np.array(truth["flow"])) | {
        "seconds": time.perf_counter() - begin,
        "points": simulation.scene.points.count,
        "mass_kg": float(simulation.scene.points.mass.sum()),
        "area_m2": float(simulation.scene.patches.area.sum()),
    }


CASE = Case(
    "Compare a soft body with Newton's, and find its wind and material from video.",
    rows,
    (
        option("--data", "folder soft of tools/datasets/make_fit_data.py", type=Path, required=True),
        option("--row", "only this one; repeatable", action="append", choices=("motion", *ROWS)),
        option("--known", "options of sim, as JSON, such as a coarser solver.dx", default="{}"),
        option("--search", "simulations of the coarse search (32)", type=int, default=32),
        UNTIL,
    ),
    page="fit.md",
)
