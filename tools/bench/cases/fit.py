"""``bench.py fit``: wind and material found from videos of our own solver and of Blender's cloth, against the truth."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from bench.cases import fit_bias, fit_reference
from bench.problems.films import write_video
from gaussian_swaying.fitting.fit import run_fit
from gaussian_swaying.fitting.plan import Plan, read_unknown
from gaussian_swaying.simulation.parameters import flow_of
from gaussian_swaying.simulation.simulation import Simulation

Row = dict[str, Any]

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


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py fit``."""
    command.add_argument("--row", action="append", choices=list(ROWS), help="only this one; repeatable")
    command.add_argument("--data", type=Path, help="folder of tools/datasets/make_fit_data.py: Blender's cloth instead")
    command.add_argument("--case", action="append", help="only this case of --data; repeatable")
    command.add_argument("--law", default="linear", help="force law for --data: linear, as in the data, or projected")
    command.add_argument(
        "--known", default="{}", help="options of sim for --data, as JSON, such as a coarser solver.dx"
    )
    command.add_argument(
        "--bias",
        action="append",
        help="no fit of --data: how far faults of the model move the values, with these options of sim, as JSON; "
        "repeatable",
    )
    command.add_argument(
        "--motion", default=fit_reference.OWN, help="the motion that --bias compares with, a file in the case's folder"
    )
    command.add_argument(
        "--reference",
        action="store_true",
        help="no fit of --data: the frames that a splat predicts which moves as the reference, as its variants, and "
        "simulated with the true values",
    )
    command.add_argument("--search", type=int, help="simulations of the coarse search")
    command.add_argument(
        "--until", type=float, help="fit the frames up to this time [s]; half of the video if left out"
    )


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``own``, ``blender``, ``bias`` or ``reference`` of the result, saving it after each row."""
    if options.bias:
        fit_bias.measure(options, _cases(options), result, save)
        return
    if options.reference:
        fit_reference.measure(options, _cases(options), result, save)
        return
    with tempfile.TemporaryDirectory() as scratch:
        if options.data is None:
            _own(options, result, save, Path(scratch))
        else:
            _blender(options, result, save, Path(scratch))


def _own(options: argparse.Namespace, result: Row, save: Callable[[Row], None], scratch: Path) -> None:
    size = SIZES[options.device]
    base = scratch / "base.yaml"
    base.write_text(yaml.safe_dump(_settings(size)), encoding="utf-8")
    simulation = Simulation.from_yaml(base, device=options.device)
    painter = simulation.painter
    cameras = {name: painter.camera_at(0, name) for name in painter.cameras}
    write_video(simulation, scratch / "video", cameras, size["frames"], size["noise"])
    until = options.until or (2.0 if options.device == "cuda" else 0.5 * (size["frames"] - 1) / 24)
    rows = result.setdefault("own", {})
    for name in options.row or ROWS:
        given = {"unknowns": SOUGHT} | ROWS[name]
        sought = [read_unknown(key, entry) for key, entry in given.pop("unknowns").items()]
        plan = Plan([str(base)], [str(scratch / "video")], sought, until=until, search=options.search or size["search"])
        rows[name] = fit_row(replace(plan, **given), scratch / name, options.device, TRUTH) | {
            "points": simulation.scene.points.count,
            "size": list(size["size"]),
            "until_s": until,
            "noise": size["noise"],
        }
        print(f"{name}: {rows[name]}", flush=True)
        save(result)


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


def _blender(options: argparse.Namespace, result: Row, save: Callable[[Row], None], scratch: Path) -> None:
    rows = result.setdefault("blender", {})
    for folder in _cases(options):
        truth = json.loads((folder / "truth.json").read_text())
        given = yaml.safe_load((folder / "fit.yaml").read_text())
        sought = [read_unknown(key, entry) for key, entry in given["unknowns"].items()]
        wanted = {"flow": truth["flow"], "material.E": truth["E"]}
        known = {"aero.law": options.law, **json.loads(options.known)}
        plan = Plan(
            [str(folder / "scene.yaml")],
            [str(folder)],
            sought,
            known=known,
            until=options.until or truth["fit_until"],
            search=options.search or 48,
        )
        for name, change in blender_rows(known, truth).items():
            if name not in (options.row or ("two cameras", "one camera")):
                continue
            key = f"{folder.name}, {name}"
            found = fit_row(replace(plan, **change), scratch / key, options.device, wanted)
            rows[key] = found | {"known": known, "until_s": plan.until, "cells": truth.get("cells")}
            print(f"{key}: {rows[key]}", flush=True)
            save(result)


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


def fit_row(plan: Plan, folder: Path, device: str, truth: Mapping[str, Any]) -> Row:
    """A fit, and how far it is from the truth."""
    begin = time.process_time()
    try:
        result = run_fit(plan, folder, device=device)
    except ValueError as error:
        return {"refused": str(error)}
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
    }


def errors(flow: list[float], truth: list[float]) -> dict[str, float]:
    """Error of the speed, as a share, and the angle between two flows [degrees]."""
    speed, true = math.hypot(*flow), math.hypot(*truth)
    along = sum(a * b for a, b in zip(flow, truth, strict=True)) / (speed * true)
    return {"speed_error": speed / true - 1, "direction_error_deg": math.degrees(math.acos(max(-1.0, min(1.0, along))))}


__all__ = ["ROWS", "blender_rows", "errors", "fit_row", "measure"]
