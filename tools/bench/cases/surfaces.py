"""What ``bench.py surfaces`` measures: how trained normals are tilted, by which losses, and what it does to a flag."""

from __future__ import annotations

import argparse
import math
import subprocess
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from bench.case import DATASET, MORE, Case, Measurement, at_once, names, option
from bench.cases.flags import VARIANTS, run_row
from bench.cases.trained import GENTLE, NORMALS, last_psnr, tilts, train_command, two_views
from bench.problems.capture_limits import surface_limits
from bench.record import ROOT, Row
from gaussian_swaying.captures.capture import read_capture

WAYS: dict[str, tuple[str, tuple[str, ...]]] = {
    "paper": ("the paper's losses", ()),
    "views": ("+ two views: `configs/train/surface.yaml`", two_views()),
    "fade": ("+ two views that fade over the last 1,500 images", two_views(fade=1500)),
    "gentle": ("+ two views, every second image, fading, only patches with contrast", GENTLE),
    "light": (
        "the same, a quarter of the patches, half the weight",
        two_views(fade=1500, every=2, contrast=0.03, samples=25_600, weight=0.5),
    ),
    "normal": (
        "+ rendered normals against depths",
        (
            "--model.loss_terms.normal=DepthNormalLoss",
            "--model.loss_weights.normal=0.05",
            "--model.loss_terms.normal.start={half}",
        ),
    ),
}
"""How a splat is trained: name to description and options of tools/train.py, as for :func:`filled`."""


def limits(photos: Path) -> Row:
    """What the cameras of the photos allow at best, for a patch of 40 cm in the middle of the flag."""
    capture = read_capture(photos)
    cameras = [view.camera for view in capture.split("train")]
    middle, facing = torch.tensor([0.6, 0.0, 0.4]), torch.tensor([0.0, -1.0, 0.0])
    return {
        f"{part} of the views": surface_limits(cameras[::step], middle, facing, 0.4)
        | {"all_views": len(cameras[::step])}
        for part, step in (("all", 1), ("a quarter", 4))
    }


def _train(photos: Path, way: str, seed: int, steps: int, target: Path) -> Row:
    """Train a splat, unless it exists, and return the seconds that it took."""
    if (target / "point_cloud.ply").exists():
        return {}
    command, log = train_command(photos.resolve(), WAYS[way][1], steps, target, seed), Path(f"{target}.log")
    begin = time.perf_counter()
    with log.open("w") as told:
        done = subprocess.run(command, cwd=ROOT, stdout=told, stderr=told)
    if done.returncode:
        raise SystemExit(log.read_text()[-2000:])
    return {"seconds": time.perf_counter() - begin}


def _look(options: argparse.Namespace, run: Path, reference: Path, scratch: Path) -> Row:
    """Normals of a trained splat, and its motion with each kind of normals, beside the reference."""
    splat = run / "point_cloud.ply"
    found: Row = {"tilt": tilts(splat, reference / "cloth.npz"), "psnr_db": last_psnr(run), "chamfer": {}}
    for normals in NORMALS:
        asked = argparse.Namespace(**vars(options) | {"frames": None, "points": 10_000})
        asked.more = f"{options.more} --scene.normals={normals}".strip()
        output = scratch / f"run_{run.name}_{normals}"
        row = run_row(options.pattern, VARIANTS["ours"], asked, splat.resolve(), output, pictures=False)
        found["chamfer"][normals] = row.get("chamfer_share", math.nan)
    return found


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Train in every way, and compare normals and motion with the reference."""
    reference = Path(options.dataset) / f"pattern{options.pattern}"
    photos = reference / "train"
    result |= {"pattern": options.pattern, "steps": options.train_steps, "at_once": options.at_once}
    result |= {"more": options.more, "limits": limits(photos)}
    before = result.setdefault("rows", {})
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(options.splats or scratch)
        home.mkdir(parents=True, exist_ok=True)
        runs = {(way, str(seed)): home / f"{way}_{seed}" for way in options.ways for seed in range(options.seeds)}
        trainings = ((place, partial(_train, photos, place[0], int(place[1]), options.train_steps, run))
                     for place, run in runs.items())  # fmt: skip
        took = {place: work() for place, work in at_once(options.at_once, trainings)}

        def look(way: str, seed: str) -> Row:
            known = before.get(way, {}).get(seed, {}) | took[way, seed]
            return known | _look(options, runs[way, seed], reference, Path(scratch))

        yield from at_once(options.at_once, ((("rows", *place), partial(look, *place)) for place in runs))


CASE = Case(
    "Measure how trained normals are tilted, by which losses, and what it does to a flag.",
    rows,
    (
        DATASET,
        option("--pattern", "which flag", type=int, default=2),
        names("--ways", WAYS),
        option("--seeds", "training runs of each", type=int, default=2),
        option("--train_steps", "images of a training run", type=int, default=7000),
        option("--at_once", "training runs, and then simulations, at the same time", type=int, default=4),
        option("--splats", "folder of the trained splats; those that exist are not trained again"),
        MORE,
    ),
    page="training.md",
)
