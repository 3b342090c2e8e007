"""What ``bench.py surfaces`` measures: how trained normals are tilted, by which losses, and what it does to a flag."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from bench.cases.flags import VARIANTS, run_row
from bench.cases.trained import GENTLE, NORMALS, filled, last_psnr, tilts, two_views
from bench.problems.capture_limits import surface_limits
from bench.record import ROOT, chosen
from gaussian_swaying.captures.capture import read_capture

Row = dict[str, Any]
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


def train_command(photos: Path, way: str, seed: int, steps: int, target: Path) -> list[str]:
    """Command line of tools/train.py."""
    return [
        *(sys.executable, str(ROOT / "tools" / "train.py"), "fit"),
        *(f"--config={ROOT}/configs/train/default.yaml", f"--config={ROOT}/configs/bench/train.yaml"),
        *(f"--trainer.max_steps={steps}", f"--trainer.val_check_interval={steps}", f"--model.seed={seed}"),
        *(f"--checkpoint.every_n_train_steps={steps}", "--trainer.enable_progress_bar=false"),
        *(f"--data.init_args.path={photos}", f"--data.init_args.seed={seed}"),
        *(f"--trainer.default_root_dir={target}", *filled(WAYS[way][1], steps)),
    ]


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py surfaces``."""
    command.add_argument("--dataset", required=True, help="folder that tools/datasets/make_flag_dataset.py wrote")
    command.add_argument("--pattern", type=int, default=2, help="which flag")
    command.add_argument("--ways", default=",".join(WAYS), help="separated by commas")
    command.add_argument("--seeds", type=int, default=2, help="training runs of each")
    command.add_argument("--train_steps", type=int, default=7000, help="images of a training run")
    command.add_argument("--at_once", type=int, default=4, help="training runs, and then simulations, at the same time")
    command.add_argument("--splats", help="folder of the trained splats; those that exist are not trained again")
    command.add_argument("--more", help="other options of tools/sim.py")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Train in every way, and compare normals and motion with the reference."""
    ways = chosen("--ways", options.ways, WAYS)
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
        jobs = [(way, seed) for seed in range(options.seeds) for way in ways]

        def train(job: tuple[str, int]) -> None:
            target = home / f"{job[0]}_{job[1]}"
            if not (target / "point_cloud.ply").exists():
                command, log = train_command(photos.resolve(), *job, options.train_steps, target), f"{target}.log"
                began = time.perf_counter()
                with Path(log).open("w") as told:
                    done = subprocess.run(command, cwd=ROOT, stdout=told, stderr=told)
                if done.returncode:
                    raise SystemExit(Path(log).read_text()[-2000:])
                rows.setdefault(job[0], {}).setdefault(str(job[1]), {})["seconds"] = time.perf_counter() - began

        with ThreadPoolExecutor(options.at_once) as pool:
            list(pool.map(train, jobs))
        lock = threading.Lock()

        def look(job: tuple[str, int]) -> None:
            way, seed = job
            run = home / f"{way}_{seed}"
            splat = run / "point_cloud.ply"
            found: Row = {"tilt": tilts(splat, reference / "cloth.npz"), "psnr_db": last_psnr(run), "chamfer": {}}
            for normals in NORMALS:
                asked = argparse.Namespace(**vars(options))
                asked.more = " ".join([options.more or "", f"--scene.normals={normals}"]).strip()
                output = Path(scratch) / f"run_{way}_{seed}_{normals}"
                row = run_row(options.pattern, VARIANTS["ours"], asked, splat.resolve(), output, pictures=False)
                found["chamfer"][normals] = row.get("chamfer_share", math.nan)
            with lock:
                rows.setdefault(way, {}).setdefault(str(seed), {}).update(found)
                print(f"{way}, seed {seed}: {json.dumps(rows[way][str(seed)])}", flush=True)
                save(result)

        with ThreadPoolExecutor(options.at_once) as pool:
            list(pool.map(look, sorted(jobs, key=lambda job: ways.index(job[0]))))
