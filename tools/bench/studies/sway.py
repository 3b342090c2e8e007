"""Do captured things sway as nature's do? The starter of the preview against what it announces, and against a table."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from bench.runner import Row, study
from gaussian_swaying import Simulation
from gaussian_swaying.cli.preview import build_options, preview_scene
from gaussian_swaying.evaluation.sway import sway_score
from gaussian_swaying.preview.results import write

SPLATS = Path(os.environ.get("SPLATS", "splats"))
"""Folder of the captures and of splats that were made to look like some."""
THINGS = {
    "plant.splat": [],
    "bush.ply": [],
    "tree.ply": [],
    "sapling.ply": [],
    "conifer.ply": [],
    "person.ply": [],
    "guitar.ply": ["--hold", "top"],
    "laundry.ply": [],
    "flag.splat": [],
    "chair.ply": [],
}


@study("sway", [{"splat": splat, "look": look} for splat in THINGS for look in ("breeze", "gusts", "storm")])
def sway(splat: str, look: str) -> Row:
    """Ten seconds, or ten periods of the first frequency, of the starter that the preview writes."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        given = [str(SPLATS / splat), "--device", "cpu", "--look", look, *THINGS[splat]]
        begin = time.perf_counter()
        preview = preview_scene(build_options().parse_args(given), folder)
        seconds = time.perf_counter() - begin
        write(preview, folder)
        told = preview.data["suggestion"]
        simulation = Simulation.from_yaml(folder / "starter.yaml", device="cpu")
        natural = told["natural"] or {"frequency_Hz": None, "lean": None}
        count = 250 if told["natural"] is None else round(max(250, 250 / natural["frequency_Hz"]))
        places, times, begin = [], [], time.perf_counter()
        for frame in simulation.frames(count):
            places.append(frame.gaussians.means.detach()[:: max(1, len(frame.gaussians.means) // 6000)].cpu())
            times.append(frame.time)
        taken = time.perf_counter() - begin
    score = asdict(sway_score(places[0], torch.stack(places) - places[0], times))
    kept = {name: round(value, 4) for name, value in score.items() if value == value}
    announced = {"kind": told["kind"]["name"], "formulation": told["formulation"]}
    announced |= {"frequency_Hz": natural["frequency_Hz"], "announced": natural["lean"]}
    return announced | kept | {"preview_s": round(seconds, 1), "frame_ms": round(1000 * taken / count, 1)}
