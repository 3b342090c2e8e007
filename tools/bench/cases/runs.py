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
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench import record
from bench.clock import Clock, timed
from bench.scenes import CUBE, sheet
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.frame import frames_from
from gaussian_swaying.simulation.simulation import Simulation

FLAG = record.ROOT / "configs" / "sim" / "flag.yaml"
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


def run_sim(name: str, arguments: list[str], device: torch.device) -> dict[str, Any]:
    """Run tools/sim.py as a user would, in its own process, and return its summary.

    On a GPU it runs twice: with an empty cache of Triton, and with the kernels that the first run has compiled.
    """
    walls = []
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(record.ROOT / "tools" / "sim.py"), *arguments, "--device", device.type]
        caches = {"TRITON_CACHE_DIR": f"{folder}/triton"} if device.type == "cuda" else {}
        for _ in range(1 + len(caches)):
            begin = time.perf_counter()
            subprocess.run(
                [*command, "--output", f"{folder}/out"], check=True, cwd=record.ROOT, env=os.environ | caches
            )
            walls.append(time.perf_counter() - begin)
        summary = json.loads((Path(folder) / "out" / "summary.json").read_text())
    summary.pop("per_frame")
    named = [Path(a).name if a.endswith(".ply") else a for a in arguments]
    took = {"process_wall_s": walls[-1]} | ({"process_compiling_s": walls[0]} if caches else {})
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
        command = [sys.executable, str(record.ROOT / "tools" / "sim.py"), "--config", str(FLAG), *COARSE]
        command += [f"--frames={frames}", "--device", device.type, "--output", str(run)]
        subprocess.run(command, check=True, cwd=record.ROOT)
        shutil.copytree(run / "frames", reference / "frames")
        positions, faces = surface_beside(run, frames)
        np.savez(reference / "cloth.npz", positions=positions, faces=faces, side=1.0)
        begin = time.perf_counter()
        command = [sys.executable, str(record.ROOT / "tools" / "eval.py"), str(run), str(reference), "--no-video"]
        subprocess.run([*command, "--device", device.type], check=True, cwd=record.ROOT, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - begin
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


def substep(options: argparse.Namespace) -> None:
    """Measure one elastic substep."""
    device, result = record.start(options.device)
    counts = [20_000, 100_000] if device.type == "cpu" else [20_000, 100_000, 1_000_000]
    variants: list[dict[str, Any]] = [{"formulation": "total"}, {"formulation": "updated"}]
    variants += [{"formulation": "updated", "mls": True}]
    if device.type == "cuda":
        variants += [{"formulation": name, "deterministic": True} for name in ("total", "updated")]
    result["substep"] = [bench_substep(device, n, **variant) for n in counts for variant in variants]
    record.write(Path(options.results), f"substep_{device.type}", result)


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py sim``."""
    command.add_argument("--ply", help="a captured object for configs/sim/hanging_object.yaml")
    command.add_argument("--frames", type=int, help="frames of the captured object; default: all")
    command.add_argument("--compared", type=int, default=250, help="frames of the comparison with a reference")
    command.add_argument("--more", help='other options of tools/sim.py: --more="--frames=25"')


def sim(options: argparse.Namespace) -> None:
    """Measure whole runs: the default flag and a captured object."""
    device, result = record.start(options.device)
    configs = record.ROOT / "configs" / "sim"
    more = options.more.split() if options.more else []
    result["runs"] = [run_sim("flag, 75 frames at 480x270", ["--config", str(configs / "flag.yaml"), *more], device)]
    if options.ply:
        hanging = ["--config", str(configs / "hanging_object.yaml"), "--scene.ply", options.ply]
        size = (
            ["--camera.init_args.width", "1920", "--camera.init_args.height", "1080"] if device.type == "cuda" else []
        )
        frames = ["--frames", str(options.frames)] if options.frames else []
        name = f"{Path(options.ply).stem}, {'1920x1080' if size else '960x540'}"
        result["runs"].append(run_sim(name, [*hanging, *size, *frames, *more], device))
        result["runs"][-1]["without_files_s"] = without_files([*hanging, *size, *frames, *more], device)
        result["round_trip_psnr_db"] = round_trip_psnr(hanging[1], options.ply, device)
    result["comparison"] = comparison(device, options.compared)
    record.write(Path(options.results), f"sim_{device.type}", result)
