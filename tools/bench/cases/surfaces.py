"""What ``bench.py surfaces`` measures: how trained normals are tilted, by which losses, and what it does to a flag."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.cases.flags import VARIANTS, run_row
from bench.record import ROOT
from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.surface_normals import neighbour_normals
from gaussian_swaying.metrics.patch_normals import patch_normal_error
from gaussian_swaying.validation.capture_limits import surface_limits

Row = dict[str, Any]
SIZES = (0.1, 0.2, 0.4)
"""Sides of the patches [m]."""

_NORMAL = ["--model.loss_terms.normal=DepthNormalLoss", "--model.loss_weights.normal=0.05"]
WAYS: dict[str, tuple[str, list[str]]] = {
    "paper": ("the paper's losses", []),
    "views": ("+ two views: `configs/train/surface.yaml`", [f"--config={ROOT}/configs/train/surface.yaml"]),
    "normal": ("+ rendered normals against depths", _NORMAL),
}
"""How a splat is trained: name to description and options of tools/train.py."""

NORMALS = {"smallest_axis": "of the smallest axes", "neighbours": "of neighbouring centres"}


def tilts(splat: Path, cloth: Path) -> Row:
    """How far the normals of a trained flag are tilted [degrees], by size of the patch and by where they come from."""
    cloud = read_gaussians(splat)
    cloud = cloud.select((torch.sigmoid(cloud.opacities) >= 0.1).nonzero()[:, 0])
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
    with np.load(cloth) as reference:
        vertices = torch.from_numpy(reference["positions"][0].astype(np.float64))
        normals = torch.from_numpy(reference["rest_normals"].astype(np.float64))
    distance, index = nearest_neighbours(vertices, 1, model.means.double())
    near = (distance[:, 0] < 0.05).nonzero()[:, 0]
    model = GaussianSurfaceModel.from_cloud(cloud.select(near), requires_grad=False)
    true, area = normals[index[near, 0]], model.areas()
    height = ((model.means.double() - vertices[index[near, 0]]) * true).sum(-1)
    own = model.normals()
    weight = model.opacity() * patch_area(model.scales)
    found = {"smallest_axis": own, "neighbours": neighbour_normals(model.means, own, weight)}
    row: Row = {"gaussians": len(model.means), "height_rms_mm": 1e3 * float(height.square().mean().sqrt())}
    for name, normal in found.items():
        cosine = (normal.double() * true).sum(-1).abs().clamp(max=1.0)
        row[name] = {"median_deg": float(torch.rad2deg(cosine.acos()).median())}
        for size in SIZES:
            parts = model.means.double(), normal.double(), true, size, area.double()
            row[name][f"tilt_{round(100 * size)}cm_deg"] = patch_normal_error(*parts)
    return row


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


def train_command(photos: Path, way: str, seed: int, steps: int, target: Path) -> list[str]:
    """Command line of tools/train.py."""
    more = list(WAYS[way][1])
    half = [f"--model.loss_terms.{name}.init_args.start={steps // 2}" for name in ("geometric", "photometric")]
    more += half if way == "views" else [f"--model.loss_terms.{way}.start={steps // 2}"] if way == "normal" else []
    return [
        *(sys.executable, str(ROOT / "tools" / "train.py"), "fit"),
        *(f"--config={ROOT}/configs/train/default.yaml", f"--config={ROOT}/configs/bench/train.yaml"),
        *(f"--trainer.max_steps={steps}", f"--trainer.val_check_interval={steps}", f"--model.seed={seed}"),
        *(f"--checkpoint.every_n_train_steps={steps}", "--trainer.enable_progress_bar=false"),
        *(f"--data.init_args.path={photos}", f"--data.init_args.seed={seed}"),
        *(f"--trainer.default_root_dir={target}", *more),
    ]


def last_psnr(run: Path) -> float | None:
    """PSNR of the held-out views at the end of a training run [dB]."""
    import csv

    with (run / "csv" / "metrics.csv").open(newline="") as text:
        found = [row["val/psnr"] for row in csv.DictReader(text) if row.get("val/psnr")]
    return float(found[-1]) if found else None


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py surfaces``."""
    command.add_argument("--dataset", required=True, help="folder that tools/datasets/make_flag_dataset.py wrote")
    command.add_argument("--pattern", type=int, default=2, help="which flag")
    command.add_argument("--ways", default=",".join(WAYS), help="separated by commas")
    command.add_argument("--seeds", type=int, default=2, help="training runs of each")
    command.add_argument("--train_steps", type=int, default=7000, help="images of a training run")
    command.add_argument("--at_once", type=int, default=4, help="training runs at the same time")
    command.add_argument("--splats", help="folder of the trained splats; those that exist are not trained again")
    command.add_argument("--more", help="other options of tools/sim.py")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Train in every way, and compare normals and motion with the reference."""
    ways = options.ways.split(",")
    if unknown := set(ways) - set(WAYS):
        raise SystemExit(f"--ways takes {', '.join(WAYS)}, not {', '.join(sorted(unknown))}")
    reference = Path(options.dataset) / f"pattern{options.pattern}"
    photos = reference / "train"
    result |= {"pattern": options.pattern, "steps": options.train_steps, "at_once": options.at_once}
    result["more"] = options.more or ""
    result["limits"] = limits(photos)
    rows = result.setdefault("rows", {})
    options.frames, options.points = None, 10_000
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(options.splats or scratch)
        home.mkdir(parents=True, exist_ok=True)
        waiting = [(way, seed) for seed in range(options.seeds) for way in ways]
        running: dict[tuple[str, int], tuple[subprocess.Popen[bytes], float]] = {}
        while waiting or running:
            while waiting and len(running) < options.at_once:
                job = waiting.pop(0)
                target = home / f"{job[0]}_{job[1]}"
                if not (target / "point_cloud.ply").exists():
                    command = train_command(photos.resolve(), *job, options.train_steps, target)
                    with (home / f"{target.name}.log").open("w") as log:
                        running[job] = (
                            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log),
                            time.perf_counter(),
                        )
            time.sleep(0.1)
            for job in [job for job, (process, _) in running.items() if process.poll() is not None]:
                process, began = running.pop(job)
                if process.returncode:
                    raise SystemExit((home / f"{job[0]}_{job[1]}.log").read_text()[-2000:])
                rows.setdefault(job[0], {}).setdefault(str(job[1]), {})["seconds"] = time.perf_counter() - began
        for way in ways:
            for seed in range(options.seeds):
                run = home / f"{way}_{seed}"
                splat = run / "point_cloud.ply"
                row = rows.setdefault(way, {}).setdefault(str(seed), {})
                row |= {"tilt": tilts(splat, reference / "cloth.npz"), "psnr_db": last_psnr(run)}
                row["chamfer"] = {}
                for normals in NORMALS:
                    asked = argparse.Namespace(**vars(options))
                    asked.more = " ".join([options.more or "", f"--scene.normals={normals}"]).strip()
                    output = Path(scratch) / f"run_{way}_{seed}_{normals}"
                    found = run_row(options.pattern, VARIANTS["ours"], asked, splat.resolve(), output, pictures=False)
                    row["chamfer"][normals] = found.get("chamfer_share", math.nan)
                print(f"{way}, seed {seed}: {json.dumps(row)}", flush=True)
                save(result)
