"""Measure, record as JSON, and make the documentation's tables from what was recorded.

``python tools/bench.py substep``    one elastic substep; writes docs/results/substep_<device>.json
``python tools/bench.py speed``      rollouts, batches and frames; writes docs/results/speed_<device>.json
``python tools/bench.py sim``        the main job end to end; writes docs/results/sim_<device>.json
``python tools/bench.py accuracy``   errors against closed forms; writes docs/results/accuracy_<device>.json
``python tools/bench.py pareto``     speed against error; writes docs/results/pareto_<device>.json
``python tools/bench.py gradients``  memory of gradients, and tools/fit_flag.py; writes docs/results/gradients_cpu.json
``python tools/bench.py train``      trainings of a capture and of a generated flag; writes docs/results/train_cuda.json
``python tools/bench.py flags``      the flag benchmark; writes docs/results/flags_<device>.json
``python tools/bench.py gallery``    the paper's scenes; writes docs/results/gallery_<device>.json and pictures
``python tools/bench.py pages``      docs/benchmarks.md, validation.md, training.md, flag_benchmark.md and gallery.md
``python tools/bench.py pictures``   a strip of frames of a finished run
``python tools/bench.py film``       the README's moving picture from finished runs
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as tools/sim.py, before torch is imported

import accuracy as accuracy_cases
import films
import flags as flag_cases
import gallery as gallery_cases
import pareto as pareto_cases
import speed as speed_cases
import torch
import training as training_cases

from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.simulation.config import build_parser, build_pipeline
from gaussian_swaying.simulation.pipeline import describe_device, versions

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"


def bench_substep(
    device: torch.device, particles: int, formulation: str, deterministic: bool = False, mls: bool = False
) -> dict[str, Any]:
    """One elastic substep, without wind; the grid of ``updated`` is the whole cube of 100³ nodes."""
    points = speed_cases.sheet(particles, device)
    solver = MPMSolver(dx=0.01, formulation=formulation, deterministic=deterministic, mls=mls)
    state = solver.init_state(points)
    if formulation == "updated":
        state = state.replace(grid=GridSpec(0.01, (0, 0, 0), (100, 100, 100)))
    with torch.inference_mode():
        result = speed_cases.timed(lambda: solver.step(state, 1e-4), device, 30)
    nodes = state.grid.node_count
    name = formulation + (", MLS" if mls else "") + (", deterministic" if deterministic else "")
    return {"particles": points.count, "formulation": name, "nodes": nodes} | result


def run_sim(name: str, arguments: list[str], device: torch.device) -> dict[str, Any]:
    """Run tools/sim.py as a user does, in its own process, and keep its summary."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "tools" / "sim.py"), *arguments, "--device", device.type]
        begin = time.perf_counter()
        subprocess.run([*command, "--output", f"{folder}/out"], check=True, cwd=ROOT)
        wall = time.perf_counter() - begin
        summary = json.loads((Path(folder) / "out" / "summary.json").read_text())
    summary.pop("per_frame")
    named = [Path(a).name if a.endswith(".ply") else a for a in arguments]
    return {"name": name, "arguments": named, "process_wall_s": wall} | summary


def round_trip_psnr(config: str, ply: str, device: torch.device) -> float:
    """PSNR between the splat as it is and the picture of frame 0 of the run, at the size of the config's camera."""
    parser = build_parser()
    settings = parser.parse_args(["--config", config, "--scene.ply", ply, "--device", device.type])
    pipeline, _ = build_pipeline(parser, settings)
    with torch.inference_mode():
        state = pipeline.start()
        moved = pipeline.render(state, 0).color
        pipeline.shader = None
        rest = pipeline.scene.rest()
        camera = pipeline.camera_at(0)
        plain = pipeline.draw(rest, pipeline.colors(rest, camera), camera).color
    error = float((moved - plain).square().mean())
    return float("inf") if error == 0 else -10 * float(torch.log10(torch.tensor(error)))


def _start(options: argparse.Namespace) -> tuple[torch.device, dict[str, Any]]:
    device = torch.device(
        options.device if options.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    )
    return device, {"device": describe_device(device), "versions": versions(), "seed": 0}


def _write(options: argparse.Namespace, name: str, result: dict[str, Any], quiet: bool = False) -> None:
    folder = Path(options.results)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    speed_cases.write_whole(path, json.dumps(result, indent=2).replace(str(ROOT) + "/", "") + "\n")
    if not quiet:
        print(f"wrote {path}")


def substep(options: argparse.Namespace) -> None:
    """Measure one elastic substep."""
    device, result = _start(options)
    counts = [20_000, 100_000] if device.type == "cpu" else [20_000, 100_000, 1_000_000]
    variants: list[dict[str, Any]] = [{"formulation": "total"}, {"formulation": "updated"}]
    variants += [{"formulation": "updated", "mls": True}]
    if device.type == "cuda":
        variants += [{"formulation": name, "deterministic": True} for name in ("total", "updated")]
    result["substep"] = [bench_substep(device, n, **variant) for n in counts for variant in variants]
    _write(options, f"substep_{device.type}", result)


def speed(options: argparse.Namespace) -> None:
    """Measure rollouts of many sizes, sand, batches and frames, with memory and error."""
    device, result = _start(options)
    result["kind"], result["threads"], result["quick"] = device.type, torch.get_num_threads(), options.quick
    if options.quick and Path(options.results).resolve() == RESULTS:
        raise SystemExit("--quick measures nothing worth keeping: give it another folder with --results")
    name = f"speed_{device.type}"
    path = Path(options.results) / f"{name}.json"
    only = options.only.split(",") if options.only else None
    if unknown := set(only or []) - set(speed_cases.SECTIONS):
        raise SystemExit(f"--only takes {', '.join(speed_cases.SECTIONS)}, not {', '.join(sorted(unknown))}")
    if only and path.exists():
        kept = json.loads(path.read_text())
        if kept["device"] == result["device"]:
            result |= {section: kept[section] for section in speed_cases.SECTIONS if section in kept}
    plan = speed_cases.plan_for(device.type, options.counts, options.quick)
    speed_cases.measure(plan, device, result, lambda now: _write(options, name, now, quiet=True), only)
    print(f"wrote {path}")


def sim(options: argparse.Namespace) -> None:
    """Measure the main job."""
    device, result = _start(options)
    more = options.more.split() if options.more else []
    flag = ["--config", str(ROOT / "configs" / "sim" / "flag.yaml"), *more]
    result["runs"] = [run_sim("flag, 75 frames at 480x270", flag, device)]
    if options.ply:
        hanging = ["--config", str(ROOT / "configs" / "sim" / "hanging_object.yaml"), "--scene.ply", options.ply]
        size = (
            ["--camera.init_args.width", "1920", "--camera.init_args.height", "1080"] if device.type == "cuda" else []
        )
        frames = ["--frames", str(options.frames)] if options.frames else []
        name = f"{Path(options.ply).stem}, {'1920x1080' if size else '960x540'}"
        result["runs"].append(run_sim(name, [*hanging, *size, *frames, *more], device))
        result["round_trip_psnr_db"] = round_trip_psnr(hanging[1], options.ply, device)
    _write(options, f"sim_{device.type}", result)


def accuracy(options: argparse.Namespace) -> None:
    """Measure errors against closed forms and experiments."""
    device, result = _start(options)
    path = Path(options.results) / f"accuracy_{device.type}.json"
    kept = json.loads(path.read_text())["rows"] if options.only and path.exists() else []
    result["rows"] = [row for row in kept if options.only not in row["problem"]]
    result["rows"] += accuracy_cases.measure(device.type, options.thorough, options.only)
    _write(options, f"accuracy_{device.type}", result)
    validation_page(options)


def pareto(options: argparse.Namespace) -> None:
    """Measure speed against error over the settings of the solver."""
    device, result = _start(options)
    result["kind"], result["threads"] = device.type, torch.get_num_threads()
    path = Path(options.results) / f"pareto_{device.type}.json"
    kept = json.loads(path.read_text())["rows"] if options.only and path.exists() else []
    wanted = options.only.split(",") if options.only else None
    result["rows"] = [row for row in kept if row["problem"] not in wanted] if wanted else []
    result["rows"] += pareto_cases.measure(device.type, wanted)
    _write(options, f"pareto_{device.type}", result)
    validation_page(options)


def gradients(options: argparse.Namespace) -> None:
    """Measure the memory of gradients through long rollouts, and fit a flag."""
    _, result = _start(argparse.Namespace(device="cpu"))
    result["memory"] = []
    for formulation in ("total", "updated"):
        for steps, checkpoint in ((50, 0), (500, 0), (500, 22), (2000, 45)):
            command = [sys.executable, str(ROOT / "tools" / "gradient_memory.py"), formulation]
            done = subprocess.run([*command, str(steps), str(checkpoint)], check=True, capture_output=True, text=True)
            result["memory"].append(json.loads(done.stdout))
            print(result["memory"][-1], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fit.json"
        subprocess.run([sys.executable, str(ROOT / "tools" / "fit_flag.py"), "--json", str(path)], check=False)
        result["fit"] = json.loads(path.read_text())
    _write(options, "gradients_cpu", result)
    validation_page(options)


def _go_on(options: argparse.Namespace, name: str, result: dict[str, Any], measure: Callable[..., None]) -> None:
    """Add to what was recorded on the same device, and write after each part."""
    path = Path(options.results) / f"{name}.json"
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["device"] == result["device"]:
            result = kept | result
    measure(options, result, lambda now: _write(options, name, now, quiet=True))
    print(f"wrote {path}")


def train(options: argparse.Namespace) -> None:
    """Measure trainings: a bare gsplat loop beside Lightning, what else helps, and what the surface losses buy."""
    device, result = _start(options)
    name = f"train_{device.type}"
    _go_on(options, name, result, training_cases.measure)


def flags(options: argparse.Namespace) -> None:
    """Train, simulate and compare the flags of the paper with Blender's cloth."""
    device, result = _start(options)
    options.device = device.type
    name = f"flags_{device.type}"
    _go_on(options, name, result, flag_cases.measure)


def gallery(options: argparse.Namespace) -> None:
    """Run and picture the paper's scenes."""
    device, result = _start(options)
    options.device = device.type
    options.preset = options.preset or ("preview" if device.type == "cpu" else None)
    name = f"gallery_{device.type}"
    _go_on(options, name, result, gallery_cases.measure)


def _gradient_lines(result: dict[str, Any]) -> list[str]:
    lines = ["## Gradients", "", f"{result['device']}; {', '.join(f'{k} {v}' for k, v in result['versions'].items())}."]
    lines += ["", "Forward and backward through a rollout of a flag, memory beyond that of the imports:", ""]
    lines += ["| formulation | substeps | `checkpoint` | memory [MiB] | seconds | dL/dE |", "|---|---|---|---|---|---|"]
    for row in result["memory"]:
        lines.append(
            f"| `{row['formulation']}` | {row['substeps']} | {row['checkpoint'] or 'none'} | {row['memory_MiB']:.0f} | "
            f"{row['seconds']:.1f} | {row['gradient_E']:.6g} |"
        )
    fit = result["fit"]
    names = [("wind", "m/s"), ("E", "Pa")]
    found = [
        f"{name} {value:.6g} {unit} (true {truth:g}, first guess {guess:g}, error {100 * error:.4f} %)"
        for (name, unit), value, truth, guess, error in zip(
            names, fit["values"], fit["truth"], fit["guess"], fit["relative_errors"], strict=True
        )
    ]
    lines += [
        "",
        "`tools/fit_flag.py` finds the wind and the stiffness of a flag from its own trajectory, recorded with",
    ]
    lines += [f"noise of {1e3 * fit['noise']:g} mm: {' and '.join(found)} in {fit['seconds']:.0f} s.", ""]
    return lines


def _long_lines(found: dict[str, Any]) -> list[str]:
    lines = ["## Ten simulated minutes of a gusty flag", ""]
    lines += [
        "`total`, recorded by the slow test of `tests/validation/test_hard_cases.py`. Without damping the wind heats",
        "the motion inside the cells, which no particle and no air sees, by some 3 % a minute; the particles move no",
        "more in the tenth minute than in the second. A damping of 0.1 1/s takes it away.",
        "",
        "| damping [1/s] | mechanical energy of each minute [J] | kinetic energy of the particles [J] | "
        "largest stretch | torn | lost | substeps | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for run in found.values():
        energy = run["energy_per_minute_J"]
        shown = [", ".join(f"{v:.3g}" for v in energy[name]) for name in ("mechanical", "kinetic_of_particles")]
        lines.append(
            f"| {run['damping_per_s']} | {shown[0]} | {shown[1]} | {run['largest_stretch']:.2f} | {run['torn']} | "
            f"{run['lost']} | {run['substeps']:,} | {run['wall_s']:.0f} |"
        )
    return [*lines, ""]


def validation_page(options: argparse.Namespace) -> None:
    """Write docs/validation.md and its plots from the recorded JSON."""
    folder = Path(options.results)
    docs = folder.parent
    lines = [
        "# Validation",
        "",
        "Made by `python tools/bench.py accuracy` and `pareto` from the JSON in `docs/results/`. What is demanded of",
        "float64 is also a test in `tests/validation/`; what nature does is reported.",
        "",
    ]
    recorded = [json.loads(p.read_text()) for p in sorted(folder.glob("accuracy_*.json"))]
    if recorded:
        lines += accuracy_cases.page(recorded, docs / "pictures")
    swept = [json.loads(p.read_text()) for p in sorted(folder.glob("pareto_*.json"))]
    if swept:
        lines += ["## Speed against error", "", *pareto_cases.page(swept, docs / "pictures")]
    for path in sorted(folder.glob("gradients_*.json")):
        lines += _gradient_lines(json.loads(path.read_text()))
    long_run = folder / "long_flag.json"
    if long_run.exists():
        lines += _long_lines(json.loads(long_run.read_text()))
    (docs / "validation.md").write_text("\n".join(lines).rstrip() + "\n")
    print(f"wrote {docs / 'validation.md'}")


GOALS = {
    "flag_cpu": "flag end to end on 2 CPU cores: within 90 s and 2 GB",
    "substep_cpu": "one elastic substep of 20,000 particles on 2 CPU cores: within 40 ms",
    "whole": "captured object over 250 frames: no particle lost, singular values of F within [0.5, 2]",
    "round_trip": "captured object, frame 0 against the splat itself: PSNR of 35 dB",
    "object_cuda": "captured object, 250 frames at 1920x1080 on one H200, files apart: within 180 s and 2 GiB",
    "object_cuda_fast": "captured object, 250 frames at 1920x1080 on one H200, files apart: within 6 s",
}


def pages(options: argparse.Namespace) -> None:
    """Write docs/benchmarks.md from the recorded JSON."""
    lines = [
        "# Benchmarks",
        "",
        "Made by `python tools/bench.py pages` from the JSON in `docs/results/`. Medians where something was repeated;",
        "the machines are shared.",
        "",
    ]
    goals = []
    for path in sorted(Path(options.results).glob("su*_*.json")) + sorted(Path(options.results).glob("sim_*.json")):
        result = json.loads(path.read_text())
        stack = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
        lines += [f"## `{path.name}`: {result['device']}", "", f"{stack}; seed {result['seed']}.", ""]
        lines += _substep_table(result) if "substep" in result else _run_table(result)
        goals += _goals(result)
    speeds = [(path.name, json.loads(path.read_text())) for path in sorted(Path(options.results).glob("speed_*.json"))]
    if speeds:
        lines += speed_cases.page(speeds, Path(options.results).parent / "pictures")
        goals += [_goal_row(*goal) for _, result in speeds for goal in speed_cases.goals(result)]
    head = ["| goal | measured | reached | stretch goal | reached |", "|---|---|---|---|---|"]
    lines += ["## Goals", "", *head, *goals, ""]
    target = Path(options.results).parent / "benchmarks.md"
    target.write_text("\n".join(lines))
    print(f"wrote {target}")
    validation_page(options)
    recorded = [json.loads(path.read_text()) for path in sorted(Path(options.results).glob("train_*.json"))]
    if recorded:
        page = Path(options.results).parent / "training.md"
        page.write_text("\n".join(training_cases.page(recorded)))
        print(f"wrote {page}")
    compared = [json.loads(path.read_text()) for path in sorted(Path(options.results).glob("flags_*.json"))]
    if compared:
        page = Path(options.results).parent / "flag_benchmark.md"
        page.write_text("\n".join(flag_cases.page(compared)))
        print(f"wrote {page}")
    scenes = [json.loads(path.read_text()) for path in sorted(Path(options.results).glob("gallery_*.json"))]
    if scenes:
        page = Path(options.results).parent / "gallery.md"
        page.write_text("\n".join(gallery_cases.page(scenes)))
        print(f"wrote {page}")


def _substep_table(result: dict[str, Any]) -> list[str]:
    lines = ["| elastic substep, sheet, no wind | grid nodes | median [ms] | quartiles [ms] |", "|---|---|---|---|"]
    for row in result["substep"]:
        quartiles = f"{row['quartile_low_ms']:.2f} to {row['quartile_high_ms']:.2f}"
        lines.append(
            f"| `{row['formulation']}`, {row['particles']:,} particles | {row['nodes']:,} | "
            f"{row['median_ms']:.2f} | {quartiles} |"
        )
    return [*lines, ""]


def _run_table(result: dict[str, Any]) -> list[str]:
    lines = [
        "| run | particles | frames | substeps | simulation [s] | shading [s] | rendering [s] | writing [s] | "
        "process [s] | host memory [GiB] | device memory [GiB] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in result["runs"]:
        wall, memory = run["wall_s"], run["peak_memory_bytes"]
        on_device = "-" if memory["device"] is None else f"{memory['device'] / 2**30:.2f}"
        lines.append(
            f"| {run['name']} | {run['particles']:,} | {run['frames']} | {run['substeps']:,} | "
            f"{wall['simulation']:.1f} | {wall['shading']:.1f} | {wall['rendering']:.1f} | {wall['writing']:.1f} | "
            f"{run['process_wall_s']:.1f} | {memory['host'] / 2**30:.2f} | {on_device} |"
        )
    lines.append("")
    for run in result["runs"]:
        lines.append(
            f"- {run['name']}: {run['lost_particles']} particles lost, singular values of F in "
            f"[{run['stretch_min']:.2f}, {run['stretch_max']:.2f}], largest CFL number {run['largest_cfl']:.2f}, "
            f"largest mean displacement {run['displacement_mean_max_m']:.3f} m."
        )
    if "round_trip_psnr_db" in result:
        lines.append(f"- PSNR of frame 0 against the splat as it was captured: {result['round_trip_psnr_db']:.1f} dB.")
    return [*lines, ""]


def _goals(result: dict[str, Any]) -> list[str]:
    rows = []
    on_cpu = "CPU" in result["device"]
    for row in result.get("substep", []):
        if on_cpu and row["particles"] < 21_000:
            measured = f"{row['median_ms']:.1f} ms (`{row['formulation']}`)"
            rows.append(_goal("substep_cpu", measured, row["median_ms"] <= 40))
    for run in result.get("runs", []):
        wall, memory = run["wall_s"], run["peak_memory_bytes"]
        if on_cpu and run["name"].startswith("flag"):
            took, used = run["process_wall_s"], memory["host"] / 1e9
            rows.append(_goal("flag_cpu", f"{took:.1f} s, {used:.2f} GB", took <= 90 and used <= 2))
        if not on_cpu and "1920x1080" in run["name"]:
            took = wall["simulation"] + wall["shading"] + wall["rendering"]
            reached = run["frames"] >= 250 and took <= 180 and memory["device"] <= 2 * 2**30
            rows.append(_goal("object_cuda", f"{took:.1f} s, {memory['device'] / 2**30:.2f} GiB", reached))
            whole = run["frames"] >= 250
            fast, faster = (whole and took <= limit for limit in (6, 3))
            rows.append(_goal("object_cuda_fast", f"{took:.1f} s", fast, "3 s", faster))
        if run["frames"] >= 250:
            whole = run["lost_particles"] == 0 and run["stretch_min"] >= 0.5 and run["stretch_max"] <= 2
            measured = f"[{run['stretch_min']:.2f}, {run['stretch_max']:.2f}], {run['lost_particles']} lost"
            rows.append(_goal("whole", f"{measured} ({'CPU' if on_cpu else 'GPU'})", whole))
    if "round_trip_psnr_db" in result:
        value = result["round_trip_psnr_db"]
        rows.append(_goal("round_trip", f"{value:.1f} dB ({'CPU' if on_cpu else 'GPU'})", value >= 35))
    return rows


def _goal(name: str, measured: str, reached: bool, stretch: str = "-", stretched: bool | None = None) -> str:
    return _goal_row(GOALS[name], measured, reached, stretch, stretched)


def _goal_row(goal: str, measured: str, reached: bool | None, stretch: str, stretched: bool | None) -> str:
    verdicts = ["-" if verdict is None else "yes" if verdict else "no" for verdict in (reached, stretched)]
    return f"| {goal} | {measured} | {verdicts[0]} | {stretch} | {verdicts[1]} |"


def film(options: argparse.Namespace) -> None:
    """An animated WebP of finished runs side by side."""
    start, stop, step = (int(number) for number in options.frames_shown.split(":"))
    width, height = (int(number) for number in options.size.split("x"))
    target = ROOT / "docs" / "pictures" / f"{options.name}.webp"
    runs = [Path(run) for run in options.runs.split(",")]
    films.film(runs, target, range(start, stop, step), (width, height), round(40 * step), options.quality)
    print(f"wrote {target}, {target.stat().st_size:,} bytes")


def pictures(options: argparse.Namespace) -> None:
    """A strip of frames of a finished run."""
    import imageio.v3 as iio
    import numpy as np

    frames = [iio.imread(Path(options.run) / "frames" / f"{int(i):05d}.png") for i in options.frames_shown.split(",")]
    left, right = (round(float(share) * frames[0].shape[1]) for share in options.columns.split(","))
    frames = [frame[:, left:right] for frame in frames]
    target = ROOT / "docs" / "pictures" / f"{options.name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(target, np.concatenate(frames, axis=1))
    print(f"wrote {target}")


def main() -> None:
    """Parse and run one command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for function in (substep, speed, sim, accuracy, pareto, gradients, train, flags, gallery, pages, pictures, film):
        command = commands.add_parser(function.__name__, help=function.__doc__)
        command.set_defaults(run_command=function)
        command.add_argument("--results", default=str(RESULTS), help="folder of the recorded JSON")
        if function in (accuracy, pareto):
            command.add_argument("--only", help="only the problems with this name (pareto: a list with commas)")
        if function is accuracy:
            command.add_argument("--thorough", action="store_true", help="finer grids and full 3D; for a GPU")
        if function in (substep, speed, sim, accuracy, pareto, train, flags, gallery):
            command.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
        if function is speed:
            command.add_argument("--counts", help="particles of the sheets, a list with commas")
            command.add_argument("--only", help=f"of {', '.join(speed_cases.SECTIONS)}: a list with commas")
            command.add_argument("--quick", action="store_true", help="tiny counts, only to see that it runs")
        if function is train:
            training_cases.add_arguments(command)
        if function is flags:
            flag_cases.add_arguments(command)
        if function is gallery:
            gallery_cases.add_arguments(command)
        if function is sim:
            command.add_argument("--ply", help="a captured object for configs/sim/hanging_object.yaml")
            command.add_argument("--frames", type=int, help="frames of the captured object; all if not given")
            command.add_argument("--more", help="further options of tools/sim.py, in quotes")
        if function is pictures:
            command.add_argument("--run", required=True, help="output folder of a run")
            command.add_argument("--name", required=True, help="name of the picture")
            command.add_argument("--frames_shown", default="0,20,40,60", help="frame numbers")
            command.add_argument("--columns", default="0,1", help="part of the width to keep, as shares")
        if function is film:
            command.add_argument("--runs", required=True, help="output folders of runs, a list with commas")
            command.add_argument("--name", default="swaying", help="name of the picture")
            command.add_argument("--frames_shown", default="0:75:2", help="first frame, the one after the last, step")
            command.add_argument("--size", default="320x320", help="of each panel [pixels]")
            command.add_argument("--quality", type=int, default=60, help="0 to 100")
    options = parser.parse_args()
    options.run_command(options)


if __name__ == "__main__":
    main()
