"""Do captured things sway as nature's do? The starter of the preview against what it announces, and against a table."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from bench.runner import Row, study
from gaussian_swaying import Simulation, suggest
from gaussian_swaying.evaluation.sway import sway_score

SPLATS = Path(os.environ.get("SPLATS", "splats"))
"""Folder of the captures and of splats that were made to look like some."""
THINGS = {
    "plant.splat": {},
    "bush.ply": {},
    "tree.ply": {},
    "sapling.ply": {},
    "conifer.ply": {},
    "person.ply": {},
    "guitar.ply": {"hold": "top"},
    "laundry.ply": {},
    "flag.splat": {},
    "chair.ply": {},
}


@study("sway", [{"splat": splat, "look": look} for splat in THINGS for look in ("breeze", "gusts", "storm")])
def sway(splat: str, look: str) -> Row:
    """Ten seconds, or ten periods of the first frequency, of the starter that the preview writes."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        begin = time.perf_counter()
        told = suggest(SPLATS / splat, look=look, device="cpu", **THINGS[splat])
        seconds = time.perf_counter() - begin
        told.to_yaml(folder / "starter.yaml")
        simulation = Simulation.from_yaml(folder / "starter.yaml", device="cpu")
        frequency, lean = (None, None) if told.natural is None else (told.natural.frequency, told.natural.lean)
        count = 250 if frequency is None else round(max(250, 250 / frequency))
        places, times, begin = [], [], time.perf_counter()
        for frame in simulation.frames(count):
            places.append(frame.gaussians.means.detach()[:: max(1, len(frame.gaussians.means) // 6000)].cpu())
            times.append(frame.time)
        taken = time.perf_counter() - begin
    score = asdict(sway_score(places[0], torch.stack(places) - places[0], times))
    kept = {name: round(value, 4) for name, value in score.items() if value == value}
    announced = {"kind": told.kind, "formulation": "modes" if told.by_modes else "total"}
    announced |= {"frequency_Hz": frequency, "announced": lean}
    return announced | kept | {"preview_s": round(seconds, 1), "frame_ms": round(1000 * taken / count, 1)}
