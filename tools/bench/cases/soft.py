"""``bench.py soft``: a soft body by Newton: our motion at the true values beside Newton's, and what fits find.

``tools/datasets/make_fit_data.py --case soft`` makes the data.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bench.cases.fit import blender_rows, fit_row
from bench.record import ROOT
from gaussian_swaying.fitting.plan import Plan, parse_base, read_unknown
from gaussian_swaying.simulation.simulation import Simulation

sys.path.append(str(ROOT / "tools" / "datasets"))  # scripts that import each other from their own folder

from soft_case import compared

Row = dict[str, Any]

ROWS = ("two cameras", "one camera")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py soft``."""
    command.add_argument("--data", type=Path, required=True, help="folder soft of tools/datasets/make_fit_data.py")
    command.add_argument("--row", action="append", choices=("motion", *ROWS), help="only this one; repeatable")
    command.add_argument("--known", default="{}", help="options of sim, as JSON, such as a coarser solver.dx")
    command.add_argument("--search", type=int, default=32, help="simulations of the coarse search (32)")
    command.add_argument(
        "--until", type=float, help="fit the frames up to this time [s]; half of the video if left out"
    )


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result["motion"]`` and ``result["fits"]``, saving after each row."""
    folder = options.data
    known = json.loads(options.known)
    truth = json.loads((folder / "truth.json").read_text())
    if (folder / "uncertainty.json").exists():
        result["reference"] = json.loads((folder / "uncertainty.json").read_text())["variants"]
        save(result)
    given = yaml.safe_load((folder / "fit.yaml").read_text())
    plan = Plan(
        [str(folder / "scene.yaml")],
        [str(folder)],
        [read_unknown(key, entry) for key, entry in given["unknowns"].items()],
        known=known,
        until=options.until or truth["fit_until"],
        search=options.search,
    )
    rows = options.row or ("motion", *ROWS)
    if "motion" in rows:
        name = ", ".join(f"`{key}` {value}" for key, value in known.items()) or "as in `scene.yaml`"
        result.setdefault("motion", {})[name] = motion(plan, folder / "gaussians.npz", truth, options.device)
        print(f"{name}: {result['motion'][name]}", flush=True)
        save(result)
    wanted = {"flow": truth["flow"], "material.E": truth["E"]}
    with tempfile.TemporaryDirectory() as scratch:
        for name in [row for row in ROWS if row in rows]:
            changed = replace(plan, **blender_rows(known, truth)[name])
            found = fit_row(changed, Path(scratch) / name, options.device, wanted)
            result.setdefault("fits", {})[name] = found | {"known": known, "until_s": plan.until}
            print(f"{name}: {result['fits'][name]}", flush=True)
            save(result)


def motion(plan: Plan, gaussians: Path, truth: Mapping[str, Any], device: str) -> Row:
    """The simulation at the true values beside the true motion of each Gaussian; lengths in metres."""
    true_values = {"wind.flow": truth["flow"], "material.E": truth["E"]}
    parser = Simulation.parser()
    settings = parse_base(replace(plan, known={**plan.known, **true_values}), parser)
    settings.device, settings.camera = device, None
    simulation = Simulation.from_settings(parser, settings)
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
