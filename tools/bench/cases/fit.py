"""``bench.py fit``: wind and material found from videos of our own solver and of Blender's cloth, against the truth."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from bench.case import UNTIL, Case, Measurement, option
from bench.cases import fit_bias, fit_reference
from bench.cases.fit_reference import plan_of
from bench.problems.films import write_video
from bench.record import Row
from gaussian_swaying.fitting.fit import run_fit
from gaussian_swaying.fitting.plan import Plan, read_unknown
from gaussian_swaying.simulation.parameters import flow_of
from gaussian_swaying.simulation.simulation import Simulation

TRUTH = {"flow": [4.0, 3.0, 0.5], "material.E": 1e4, "material.density": 25.0, "aero.C_D": 0.1}
SOUGHT = {"wind.speed": [2, 12], "wind.azimuth": [-20, 100], "wind.elevation": [-30, 30], "material.E": [2e3, 5e4]}
PUSH = 0.26
"""C_D = C_F of a force per particle that is, on the flag at rest in the true wind, as large as that on the patches."""

SIZES = {
    "cpu": {"flag": (0.4, 0.3, 0.05), "dx": 0.1, "size": (200, 120), "frames": 37, "search": 24, "noise": 3.0},
    "cuda": {"flag": (0.6, 0.4, 0.0125), "dx": 0.03, "size": (480, 270), "frames": 73, "search": 64, "noise": 3.0},
}
"""What fits a CPU; and two videos of 3 s, of which the first 2 s are fitted, for a GPU."""

ROWS: dict[str, dict[str, Any]] = {
    "two cameras": {},
    "one camera": {"cameras": ["left"]},
    "tracks alone": {"stages": ["tracks"]},
    "pixels alone": {"stages": ["pixels"]},
    "without patches": {"known": {"aero.law": "projected", "aero.C_D": PUSH, "aero.C_F": PUSH, "aero.C_L": 0.0}},
    "five unknowns": {"unknowns": {**SOUGHT, "aero.C_D": [0.02, 0.5]}},
    "five unknowns, pixels last": {
        "unknowns": {**SOUGHT, "aero.C_D": [0.02, 0.5]},
        "stages": ["tracks", "matches", "pixels"],
    },
    "with the density": {"unknowns": {**SOUGHT, "material.density": [10, 60]}},
}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Fits of our own videos or of Blender's, or what ``--bias`` or ``--reference`` ask for instead."""
    if options.bias:
        yield from fit_bias.rows(options, _cases(options))
    elif options.reference:
        yield from fit_reference.rows(options, _cases(options))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            yield from (_own if options.data is None else _blender)(options, Path(scratch))


def _own(options: argparse.Namespace, scratch: Path) -> Iterator[Measurement]:
    size = SIZES[options.device]
    base = scratch / "base.yaml"
    base.write_text(yaml.safe_dump(_settings(size)), encoding="utf-8")
    simulation = Simulation.from_yaml(base, device=options.device)
    painter = simulation.painter
    cameras = {name: painter.camera_at(0, name) for name in painter.cameras}
    write_video(simulation, scratch / "video", cameras, size["frames"], size["noise"])
    until = options.until or (2.0 if options.device == "cuda" else 0.5 * (size["frames"] - 1) / 24)
    about = {"points": simulation.scene.points.count, "size": list(size["size"]), "until_s": until}
    for name in options.row or ROWS:
        given = {"unknowns": SOUGHT} | ROWS[name]
        sought = [read_unknown(key, entry) for key, entry in given.pop("unknowns").items()]
        plan = Plan([str(base)], [str(scratch / "video")], sought, until=until, search=options.search or size["search"])
        more = about | {"noise": size["noise"]}
        yield ("own", name), partial(fit_row, replace(plan, **given), scratch / name, options.device, TRUTH, more)


def _settings(size: Mapping[str, Any]) -> Row:
    """The printed flag of a size."""
    width, height, spacing = size["flag"]
    flag = {"width": width, "height": height, "spacing": spacing, "ripple": 0.01, "pattern": "printed"}
    pole = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [max(1.2 * spacing, 0.03), None, None]}}
    reach = width / 0.6

    def camera(x: float, y: float, z: float) -> Row:
        eye, target = [x * reach, y * reach, z * reach], [0.3 * reach, 0.0, 0.2 * reach]
        view = {"eye": eye, "target": target, "width": size["size"][0], "height": size["size"][1]}
        return {"class_path": "LookAtCamera", "init_args": view}

    return {
        "frame_dt": 1 / 24,
        "scene": {"generator": {"class_path": "FlagScene", "init_args": flag}, "metres_per_unit": 1.0},
        "material": {"E": TRUTH["material.E"], "nu": 0.3, "density": TRUTH["material.density"], "thickness": 0.01},
        "solver": {
            "dx": size["dx"],
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": None, "region": pole}}],
        },
        "wind": {"flow": TRUTH["flow"]},
        "aero": {"C_D": TRUTH["aero.C_D"], "C_F": 0.3, "C_L": 0.005},
        "cameras": {"left": camera(0.0, -1.1, 0.4), "right": camera(0.9, -0.9, 0.3)},
    }


def _blender(options: argparse.Namespace, scratch: Path) -> Iterator[Measurement]:
    for folder in _cases(options):
        known = {"aero.law": options.law, **json.loads(options.known)}
        plan, truth = plan_of(folder, known, options.until, options.search or 48)
        wanted = {"flow": truth["flow"], "material.E": truth["E"]}
        more = {"known": known, "until_s": plan.until, "cells": truth.get("cells")}
        for name, change in blender_rows(known, truth).items():
            if name in (options.row or ("two cameras", "one camera")):
                key = f"{folder.name}, {name}"
                work = partial(fit_row, replace(plan, **change), scratch / key, options.device, wanted, more)
                yield ("blender", key), work


def _cases(options: argparse.Namespace) -> list[Path]:
    """Folders of the cases that are wanted."""
    found = sorted(path.parent for path in options.data.glob("*/transforms.json"))
    return [folder for folder in found if not options.case or folder.name in options.case]


def blender_rows(known: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What each row of a case of Blender's cloth changes in its plan.

    Without patches, the force is along the wind, whatever the normal, and as large as the true one on the flag at rest,
    which lies along x.
    """
    push = truth["C_D"] * abs(truth["flow"][1]) / truth["speed"]
    return {
        "two cameras": {},
        "one camera": {"cameras": ["camera0"]},
        "tracks alone": {"stages": ["tracks"]},
        "pixels alone": {"stages": ["pixels"]},
        "without patches": {"known": {**known, "aero.law": "projected", "aero.C_D": push, "aero.C_F": push}},
    }


def fit_row(plan: Plan, folder: Path, device: str, truth: Mapping[str, Any], more: Mapping[str, Any]) -> Row:
    """A fit, how far it is from the truth, and ``more``."""
    begin = time.process_time()
    try:
        result = run_fit(plan, folder, device=device)
    except ValueError as error:
        return {"refused": str(error), **more}
    flow = flow_of(truth["flow"], result.values)
    return {
        "values": result.values,
        "standard_errors": result.errors,
        **errors(flow, truth["flow"]),
        **{f"{n}_error": v / truth[n] - 1 for n, v in result.values.items() if n in truth},
        "psnr_fitted_db": min(shown.fitted for shown in result.shown),
        "psnr_predicted_db": min(shown.predicted for shown in result.shown),
        "psnr_rest_db": min(shown.rest for shown in result.shown),
        "iterations": len(result.history),
        "seconds": result.seconds,
        "processor_s": time.process_time() - begin,
        "not_determined": result.vague,
        "not_settled": result.unsettled,
        **more,
    }


def errors(flow: list[float], truth: list[float]) -> dict[str, float]:
    """Error of the speed, as a share, and the angle between two flows [degrees]."""
    speed, true = math.hypot(*flow), math.hypot(*truth)
    along = sum(a * b for a, b in zip(flow, truth, strict=True)) / (speed * true)
    return {"speed_error": speed / true - 1, "direction_error_deg": math.degrees(math.acos(max(-1.0, min(1.0, along))))}


CASE = Case(
    "Find wind and material from videos, and compare with the truth.",
    rows,
    (
        option("--row", "only this one; repeatable", action="append", choices=list(ROWS)),
        option("--data", "folder of tools/datasets/make_fit_data.py: Blender's cloth instead", type=Path),
        option("--case", "only this case of --data; repeatable", action="append"),
        option("--law", "force law for --data: linear, as in the data, or projected", default="linear"),
        option("--known", "options of sim for --data, as JSON, such as a coarser solver.dx", default="{}"),
        option("--bias", "no fit of --data: how far faults of the model move the values, with these options of sim, as "
               "JSON; repeatable", action="append"),
        option("--motion", "the motion that --bias compares with, a file in the case's folder",
               default=fit_reference.OWN),
        option("--reference", "no fit of --data: the frames that a splat predicts which moves as the reference, as its "
               "variants, and simulated with the true values", action="store_true"),
        option("--search", "simulations of the coarse search", type=int),
        UNTIL,
    ),
    page="fit.md",
)  # fmt: skip
