"""``bench.py sweeps``: disturbed sweeps, many small flags on one and two GPUs, and training on one and two GPUs."""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning.pytorch.callbacks import Callback

from bench.case import Case, Measurement, option
from bench.cases.training import evaluate
from bench.clock import safely
from bench.problems.small_sweep import AXES, SETTINGS
from bench.record import ROOT, Row
from gaussian_swaying.captures.transforms import find_image
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.training.data.datamodule import CaptureDataModule

SECTIONS = ("workers", "gpus", "training")
LOCK = ".gaussian_swaying.lock"

_QUIET = {
    "recorder.images": False,
    "recorder.video": False,
    "recorder.trajectory": False,
    "recorder.nodes": False,
    "recorder.checkpoint_every": 0,
}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The wanted sections."""
    wanted = options.only or (["workers"] if options.device == "cpu" else ["gpus", "training"])
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        if "workers" in wanted:
            yield ("workers",), partial(disturbed_sweep, place)
        if "gpus" in wanted:
            result["gpus"] = {"flags": options.flags, "frames": options.frames, "rows": {}}
            for count in options.gpus:
                yield ("gpus", "rows", str(count)), safely(many_flags, place, options, count)
            yield ("gpus", "sheet"), safely(one_sheet, options)
        if "training" in wanted and options.capture:
            result["training"] = {"images": options.train_steps, "rows": {}}
            capture = enlarged(Path(options.capture), place / "fox", 2)
            for count in options.gpus:
                yield ("training", "rows", str(count)), safely(train, place, capture, options, count)


def _command(*words: str, gpus: int | None = None) -> subprocess.Popen[str]:
    shown = {} if gpus is None else {"CUDA_VISIBLE_DEVICES": ",".join(map(str, range(gpus)))}
    path = os.pathsep.join([str(ROOT), str(ROOT / "tools"), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, *words], env=os.environ | shown | {"PYTHONPATH": path}, stderr=subprocess.PIPE, text=True
    )


def _sweep(file: Path, output: Path, *more: str, gpus: int | None = None) -> subprocess.Popen[str]:
    program = "import sys; from gaussian_swaying.cli.main import main; sys.exit(main())"
    return _command("-c", program, "sweep", str(file), "--output", str(output), *more, gpus=gpus)


def _finish(process: subprocess.Popen[str]) -> None:
    _, told = process.communicate()
    if process.returncode:
        raise RuntimeError(told[-1500:])


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# ---- workers that are killed


def disturbed_sweep(place: Path, runs: int = 40, kills: int = 5, seed: int = 2) -> Row:
    """A sweep of small flags undisturbed, and with a worker killed at random some times: are their tables equal?"""
    file = _sweep_file(place / "small.yaml", SETTINGS, AXES, runs // 4)
    common = ("--workers", "2", "--device", "cpu")
    found: Row = {"runs": runs, "workers": 2}
    for name, times in (("undisturbed", 0), ("disturbed", kills)):
        begin, process = time.perf_counter(), _sweep(file, place / name, *common)
        killed: list[int] = []
        killer = threading.Thread(target=_kill, args=(place / name, times, random.Random(seed), process, killed))
        killer.start()
        _finish(process)
        killer.join()
        rows = _rows(place / name / "sweep.csv")
        found[name] = {
            "seconds": time.perf_counter() - begin,
            "killed": len(killed),
            "complete": sum(row["status"] == "complete" for row in rows),
            "attempts": sum(int(row["attempts"]) for row in _rows(place / name / "times.csv")),
        }
        print(f"{name}: {json.dumps(found[name])}", flush=True)
    tables = [(place / name / "sweep.csv").read_bytes() for name in ("undisturbed", "disturbed")]
    return found | {"equal": tables[0] == tables[1]}


def _kill(folder: Path, times: int, stream: random.Random, sweep: subprocess.Popen[str], killed: list[int]) -> None:
    """Kill workers at random moments, some times; their numbers go into ``killed``."""
    while len(killed) < times and sweep.poll() is None:
        time.sleep(stream.uniform(0.0, 0.5))
        holders = []
        for lock in (folder / "runs").glob(f"*/{LOCK}"):
            with suppress(OSError, ValueError):  # it has just ended
                holders.append(int(json.loads(lock.read_bytes())["pid"]))
        if holders:
            with suppress(ProcessLookupError):
                os.kill(chosen := stream.choice(holders), signal.SIGKILL)
                killed.append(chosen)


def _sweep_file(path: Path, settings: Row, axes: Row, draws: int) -> Path:
    flag = str(ROOT / "configs" / "sim" / "flag.yaml")
    path.write_text(yaml.safe_dump({"base": flag, "settings": settings, "axes": axes, "draws": draws}, sort_keys=False))
    return path


# ---- many small flags


def _flag(side: float, spacing: float, frames: int) -> Row:
    """Options of a square flag whose pole side is held at the nodes, without files."""
    pole = {"class_path": "Box", "init_args": {"min": [None, None, None], "max": [1.05 * spacing, None, None]}}
    return _QUIET | {
        "frames": frames,
        "scene.generator.init_args.width": side,
        "scene.generator.init_args.height": side,
        "scene.generator.init_args.spacing": spacing,
        "solver.dx": 2 * spacing,
        "solver.boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": pole}}],
    }


def many_flags(place: Path, options: argparse.Namespace, gpus: int) -> Row:
    """A sweep of flags of 4,096 points, one rollout on each GPU."""
    axes = {
        "wind.flow": [[4.0, 1.0, 0.0], [5.0, 1.2, 0.0], [6.0, 1.5, 0.0], [7.0, 1.8, 0.0]],
        "wind.seed": {"draw": "integer", "low": 0, "high": 10**6},
    }
    file = _sweep_file(place / "flags.yaml", _flag(0.8, 0.0125, options.frames), axes, options.flags // 4)
    together = str(-(-options.flags // gpus))
    begin = time.perf_counter()
    _finish(_sweep(file, place / f"flags{gpus}", "--together", together, "--device", options.device, gpus=gpus))
    wall = time.perf_counter() - begin
    rows, times = (_rows(place / f"flags{gpus}" / name) for name in ("sweep.csv", "times.csv"))
    updates = sum(int(row["particles"]) * int(row["substeps"]) for row in rows)
    seconds = sum(float(row["simulation_s"]) for row in times) / gpus  # each GPU's share, all at the same time
    return {
        "complete": sum(row["status"] == "complete" for row in rows),
        "attempts": max(int(row["attempts"]) for row in times),
        "particles": int(rows[0]["particles"]),
        "substeps": sum(int(row["substeps"]) for row in rows) / len(rows),
        "wall_s": wall,
        "frames_s": seconds,
        "per_s": updates / seconds,
        "memory_bytes": max((int(row["device_bytes"]) for row in times if row["device_bytes"]), default=None),
    }


def one_sheet(options: argparse.Namespace, frames: int = 60) -> Row:
    """Frames of a single flag with as many points, cells as large and the wind of the others."""
    side = 0.8 * options.flags**0.5
    words = ["--config", str(ROOT / "configs" / "sim" / "flag.yaml"), "--device", options.device]
    for name, value in _flag(side, 0.0125, frames).items():
        words += [f"--{name}", json.dumps(value)]
    parser = Simulation.parser()
    begin = time.perf_counter()
    simulation = Simulation.from_settings(parser, parser.parse_args(words))
    found = simulation.frames(frames)
    for _ in range(5):
        next(found)
    built, updates, start = time.perf_counter() - begin, 0, time.perf_counter()
    for frame in found:
        updates += frame.health.substeps * simulation.scene.points.count
    seconds = time.perf_counter() - start  # every frame waits for the device
    row = {"particles": simulation.scene.points.count, "frames": frames - 5, "frames_s": seconds}
    return row | {"per_s": updates / seconds, "build_s": built}


# ---- training


def enlarged(capture: Path, folder: Path, factor: int) -> Path:
    """A capture with photos that are larger by a factor along each side; photos that are missing are left out."""
    from PIL import Image

    read = json.loads((capture / "transforms.json").read_text())
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        read[name] = read[name] * factor
    frames, read["frames"] = read["frames"], []
    for frame in frames:
        photo = find_image(capture, frame["file_path"])  # as the reader does
        if photo is None:
            continue
        target = folder / photo.relative_to(capture)
        target.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(photo) as image:
            size = (image.width * factor, image.height * factor)
            image.resize(size, Image.Resampling.LANCZOS).save(target, quality=97)
        read["frames"].append(frame)
    (folder / "transforms.json").write_text(json.dumps(read))
    return folder


class Stopwatch(Callback):
    """Writes how long Lightning trained, from the first image to the last.

    Args:
        path: The JSON file.
    """

    def __init__(self, path: str) -> None:
        self.path, self.begin = Path(path), 0.0

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        """Start."""
        self.begin = self._now()

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        """Stop."""
        found = {"seconds": self._now() - self.begin, "steps": trainer.global_step, "devices": trainer.world_size}
        if trainer.is_global_zero:
            self.path.write_text(json.dumps(found))

    @staticmethod
    def _now() -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return time.perf_counter()


def train(place: Path, capture: Path, options: argparse.Namespace, gpus: int) -> Row:
    """Train the capture with the photometric loss on some GPUs; PSNR is that of the written splat."""
    folder, watch = place / f"train{gpus}", place / f"train{gpus}.json"
    words = ["fit", "--config", "fox", f"--data.init_args.path={capture}", f"--trainer.max_steps={options.train_steps}"]
    words += [f"--trainer.devices={gpus}", "--trainer.limit_val_batches=0", f"--trainer.default_root_dir={folder}"]
    words += [f"--model.loss_weights.{name}=0" for name in ("anisotropy", "entropy", "size")]
    words += ["--trainer.accelerator=" + ("gpu" if options.device == "cuda" else "cpu")]
    clock = [{"class_path": f"{__name__}.Stopwatch", "init_args": {"path": str(watch)}}]
    words += [f"--trainer.callbacks={json.dumps(clock)}", f"--checkpoint.every_n_train_steps={options.train_steps}"]
    _finish(_command(str(ROOT / "tools" / "train.py"), *words, gpus=gpus))
    data = CaptureDataModule(capture, test_every=8)
    data.setup("test")
    device = torch.device(options.device)
    (ply,) = folder.rglob("*.ply")
    model = GaussianSurfaceModel.from_ply(ply, requires_grad=False).to(device)
    held: Any = data.test_dataloader().dataset
    with torch.no_grad():
        row: Row = evaluate(model, [held[index] for index in range(len(held))])
    return json.loads(watch.read_text()) | row | {"gaussians": len(model), "plys": 1}


CASE = Case(
    "Measure disturbed sweeps, many small flags and training, on one and several GPUs.",
    rows,
    (
        option("--only", "what to measure; on a CPU only `workers`", nargs="+", choices=SECTIONS),
        option("--flags", "small flags of the section `gpus`", type=int, default=256),
        option("--frames", "frames of each of them", type=int, default=1000),
        option("--gpus", "numbers of GPUs", type=int, nargs="+", default=[1, 2]),
        option("--capture", "folder of the fox, for the section `training`"),
        option("--train_steps", "images of a training", type=int, default=7000),
    ),
    page="many.md",
)
