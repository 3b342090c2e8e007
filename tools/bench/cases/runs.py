"""What ``bench.py substep`` and ``bench.py sim`` measure: one elastic substep, and whole runs."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.case import MORE, Case, Measurement, option
from bench.clock import Clock, timed
from bench.record import ROOT, Row
from bench.scenes import CUBE, sheet
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.frame import frames_from
from gaussian_swaying.simulation.simulation import Simulation

FLAG = ROOT / "configs" / "sim" / "flag.yaml"
COARSE = ("--solver.dx=0.1", "--scene.generator.init_args.spacing=0.0095", "--recorder.trajectory=true")


def bench_substep(
    device: torch.device, particles: int, formulation: str, deterministic: bool = False, mls: bool = False
) -> dict[str, Any]:
    """One elastic substep, without wind; the grid of ``updated`` is the whole cube of 100³ nodes."""
    points = sheet(particles, device)
    solver = MPMSolver(dx=CUBE.dx, formulation=formulation, deterministic=deterministic, mls=mls)
    state = solver.init_state(points)
    if formulation == "updated":
        state = state.replace(grid=CUBE)
    with torch.inference_mode():
        result = timed(lambda: solver.step(state, 1e-4), device, 30)
    nodes = state.grid.node_count
    name = formulation + (", MLS" if mls else "") + (", deterministic" if deterministic else "")
    return {"particles": points.count, "formulation": name, "nodes": nodes} | result


def _tool(name: str, *arguments: str, **environment: str) -> float:
    """Seconds that a program of the folder tools takes; Python keeps its bytecode, as of an installed package."""
    begin = time.perf_counter()
    command = [sys.executable, str(ROOT / "tools" / f"{name}.py"), *arguments]
    given = os.environ | {"PYTHONDONTWRITEBYTECODE": ""} | environment
    subprocess.run(command, check=True, cwd=ROOT, env=given, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin


def run_sim(name: str, arguments: list[str], device: torch.device) -> Row:
    """Run tools/sim.py as a user would, in its own process, and return its summary.

    It runs twice: with empty caches of kernels, and with the kernels that the first run has compiled.
    """
    walls = []
    with tempfile.TemporaryDirectory() as folder:
        caches = {"TRITON_CACHE_DIR": f"{folder}/triton", "GAUSSIAN_SWAYING_CACHE": f"{folder}/kernels"}
        for _ in range(2):
            walls.append(_tool("sim", *arguments, "--device", device.type, "--output", f"{folder}/out", **caches))
        summary = json.loads((Path(folder) / "out" / "summary.json").read_text())
    summary.pop("per_frame")
    named = [Path(a).name if a.endswith(".ply") else a for a in arguments]
    took = {"process_wall_s": walls[1], "process_compiling_s": walls[0]}
    return {"name": name, "arguments": named} | took | summary


@torch.inference_mode()
def without_files(arguments: list[str], device: torch.device) -> float:
    """Seconds in which all frames of a run are simulated and drawn, after a first one that loads the kernels."""
    parser = Simulation.parser()
    with torch.inference_mode(False):
        settings = parser.parse_args([*arguments, "--device", device.type])
        simulation = Simulation.from_settings(parser, settings)
    drawn = torch.cuda.Stream(device) if device.type == "cuda" else None
    simulation.painter.render(simulation.advance(simulation.start())[0], 0)
    state = simulation.start()
    clock = Clock(device)
    begin = time.perf_counter()
    for frame in frames_from(simulation.painter, simulation.editor, state, 0, settings.frames, drawn):
        with torch.cuda.stream(drawn):
            simulation.painter.render(frame.state, frame.index)
    clock.wait()
    return time.perf_counter() - begin


def comparison(device: torch.device, frames: int) -> dict[str, Any]:
    """The time of tools/eval.py, in its own process: a flag against its own pictures and a surface beside it."""
    with tempfile.TemporaryDirectory() as folder:
        run, reference = Path(folder) / "run", Path(folder) / "reference"
        on = ("--device", device.type)
        _tool("sim", "--config", str(FLAG), *COARSE, f"--frames={frames}", *on, "--output", str(run))
        shutil.copytree(run / "frames", reference / "frames")
        positions, faces = surface_beside(run, frames)
        np.savez(reference / "cloth.npz", positions=positions, faces=faces, side=1.0)
        wall = _tool("eval", str(run), str(reference), "--no-video", *on)
        summary = json.loads((run / "summary.json").read_text())
        found = json.loads((run / "eval" / "eval.json").read_text())
    known = {"frames": frames, "particles": summary["recorded_surface"], "picture": found["size"]}
    return known | {"points": found["reference_points"], "process_wall_s": wall}


def surface_beside(run: Path, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, V, 3) [m] and squares (F, 4) of a surface one centimetre beside the flag of a run."""
    trajectory = run / "trajectory.npz"
    to_scene = SimFrame.from_summary(json.loads((run / "summary.json").read_text())).point_to_scene
    places = np.stack([to_scene(load_trajectory(trajectory, frame)[0]).numpy() for frame in range(frames)])
    columns, rows = (np.unique(places[0, :, axis].round(4), return_inverse=True)[1] for axis in (0, 2))
    vertex = np.empty((rows.max() + 1, columns.max() + 1), dtype=np.int64)
    vertex[rows, columns] = np.arange(len(rows))
    squares = np.stack([vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1]], -1).reshape(-1, 4)
    return places + np.array([0.0, 0.01, 0.0], dtype=places.dtype), squares


def round_trip_psnr(config: str, ply: str, device: torch.device) -> float:
    """PSNR between the splat as it is and the picture of frame 0 of the run, at the size of the config's camera."""
    parser = Simulation.parser()
    settings = parser.parse_args(["--config", config, "--scene.ply", ply, "--device", device.type])
    simulation = Simulation.from_settings(parser, settings)
    with torch.inference_mode():
        state = simulation.start()
        moved = simulation.painter.render(state, 0).color
        simulation.painter.shader = None
        rest = simulation.scene.rest()
        camera = simulation.painter.camera_at(0)
        plain = simulation.painter.draw(rest, simulation.painter.colors(rest, camera), camera).color
    error = float((moved - plain).square().mean())
    return float("inf") if error == 0 else -10 * float(torch.log10(torch.tensor(error)))


def _substeps(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Each size in each formulation."""
    result["substep"] = []
    device = torch.device(options.device)
    variants: list[dict[str, Any]] = [{"formulation": "total"}, {"formulation": "updated"}]
    variants += [{"formulation": "updated", "mls": True}]
    if device.type == "cuda":
        variants += [{"formulation": name, "deterministic": True} for name in ("total", "updated")]
    for count in [20_000, 100_000, 1_000_000][: 3 if device.type == "cuda" else 2]:
        for variant in variants:
            yield ("substep", {"asked": count} | variant), partial(bench_substep, device, count, **variant)


def _runs(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The default flag, a captured object, and a comparison with a reference."""
    result["runs"] = []
    device, more = torch.device(options.device), options.more.split()
    name = "flag, 75 frames at 480x270"
    yield ("runs", {"name": name}), partial(run_sim, name, ["--config", str(FLAG), *more], device)
    if options.ply:
        config = str(ROOT / "configs" / "sim" / "hanging_object.yaml")
        asked = ["--config", config, "--scene.ply", options.ply]
        large = ["--camera.init_args.width", "1920", "--camera.init_args.height", "1080"]
        asked += large if device.type == "cuda" else []
        asked += [*(["--frames", str(options.frames)] if options.frames else []), *more]
        name = f"{Path(options.ply).stem}, {'1920x1080' if device.type == 'cuda' else '960x540'}"
        yield (
            ("runs", {"name": name}),
            lambda: run_sim(name, asked, device) | {"without_files_s": without_files(asked, device)},
        )
        result["round_trip_psnr_db"] = round_trip_psnr(config, options.ply, device)
    yield ("comparison",), partial(comparison, device, options.compared)


SUBSTEP = Case("Measure one elastic substep.", _substeps, keeps="none")
SIM = Case(
    "Measure whole runs: the default flag and a captured object.",
    _runs,
    (
        option("--ply", "a captured object for configs/sim/hanging_object.yaml"),
        option("--frames", "frames of the captured object; default: all", type=int),
        option("--compared", "frames of the comparison with a reference", type=int, default=250),
        MORE,
    ),
    keeps="none",
)
