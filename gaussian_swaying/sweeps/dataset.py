"""The folder of a sweep: its description, the result of every run, their table, WebDataset shards, and one picture."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image, ImageDraw, ImageFont, ImageOps

from gaussian_swaying._checks import check_whole
from gaussian_swaying._files import atomic, remove_temporaries, write_json, write_table
from gaussian_swaying._inputs import read_json
from gaussian_swaying.recording.checkpoint import first_change
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.runs.folder import claim_folder, hold_folder
from gaussian_swaying.sweeps.plan import Plan

SWEEP, TABLE, PARQUET = "sweep.json", "sweep.csv", "sweep.parquet"
SHARDS = "shards"
MOST_SHOWN = 200  # runs on the contact sheet
WIDTH, HEIGHT, BAND, GAP = 240, 160, 34, 4  # pixels of a picture, of the text below it, and between two
RUNS, RESULTS, LOGS = "runs", "results", "logs"
OURS = (SWEEP, TABLE, PARQUET, RUNS, RESULTS, LOGS)
FIGURES = (
    *("frames", "substeps", "simulated_s", "particles", "gaussians", "mass_kg", "patch_area_m2"),
    *("displacement_mean_max_m", "wind_work_J", "largest_cfl", "stretch_min", "stretch_max"),
    *("lost_particles", "torn_particles"),
)  # of ``summary.json``, no times of the clock
ENERGIES = ("kinetic", "elastic", "potential")
SUMMARY = (*FIGURES, *(f"{name}_end_J" for name in ENERGIES), "warnings")


@contextmanager
def open_folder(folder: Path, plan: Plan, resume: bool, together: int = 1) -> Iterator[None]:
    """Make the folder of a sweep, or check the one that is continued, and lock it inside the block."""
    held, remedy = (folder / SWEEP).exists(), "choose another with --output"
    if resume and not held:
        raise ValueError(f"There is nothing to resume in {folder}: it has no {SWEEP}; leave out --resume.")
    if held and not resume:
        raise ValueError(
            f"The output folder {folder} holds a sweep already: add --resume to do what is missing in it, or {remedy}."
        )
    new: Any = {"made_by": "gaussian_swaying", "format": 1, "frames": plan.frames, "runs": list(map(dict, plan.runs))}
    new |= {"splats": dict(plan.splats), "config": yaml.safe_load(plan.config)}
    new = json.loads(json.dumps(new | ({"together": together} if together > 1 else {})))  # as it is read again
    if held and (old := read_record(folder)) != new:
        what = f"it has {len(old['runs'])} runs, and now there are {len(new['runs'])}"
        if len(old["runs"]) == len(new["runs"]):
            what = first_change(json.dumps(old), json.dumps(new))
        raise ValueError(f"{folder} holds a sweep with other settings ({what}): restore them, or {remedy}.")
    lock = hold_folder(folder, remedy) if held else claim_folder(folder, OURS, remedy)
    try:
        remove_temporaries(folder)  # of a sweep that was killed while writing
        if not held:
            write_json(folder / SWEEP, new)
        for name in (RUNS, RESULTS, LOGS):
            (folder / name).mkdir(exist_ok=True)
        yield
    finally:
        lock.release()


def read_record(folder: Path) -> dict[str, Any]:
    """``sweep.json`` of a folder: the shared configuration, frames, and the value of every axis in each run."""
    if not (folder / SWEEP).is_file():
        raise ValueError(f"{folder} is not the folder of a sweep: it has no {SWEEP}; check the path.")
    record = read_json(folder / SWEEP, "record of the sweep")
    if not isinstance(record, dict) or not isinstance(record.get("runs"), list) or not record["runs"]:
        raise ValueError(f"{folder / SWEEP} lists no runs: it is damaged; start the sweep again in another folder.")
    return record


def read_results(folder: Path, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The results of those runs that have ended, by name."""
    found = {}
    for path in (folder / RESULTS / f"{name}.json" for name in names):
        if path.exists():
            result = None
            with suppress(ValueError):
                result = read_json(path, "result")
            if not isinstance(result, dict) or not isinstance(result.get("status"), str):
                raise ValueError(f"{path} is damaged: remove it, and --resume does its run again.")
            found[path.stem] = result
    return found


def result_of(summary: Mapping[str, Any], attempt: int, where: str) -> dict[str, Any]:
    """The result of a complete run."""
    end = summary.get("energy_end_J") or {}
    figures = {name: summary.get(name) for name in FIGURES} | {f"{name}_end_J": end.get(name) for name in ENERGIES}
    figures["warnings"] = len(summary.get("warnings") or ())
    result = {"status": summary["status"], "reason": None, "figures": figures, "attempts": attempt, "where": where}
    return result | {name: summary.get(name) for name in ("wall_s", "peak_memory_bytes")}


def write_tables(folder: Path, plan: Plan, results: Mapping[str, Any], parquet: bool = False) -> None:
    """Write ``sweep.csv``, a row per run in their order; and ``sweep.parquet`` with numbers and lists as such."""
    rows = []
    for name, run in zip(plan.names, plan.runs, strict=True):
        result = results.get(name) or {"status": "missing"}
        figures = result.get("figures") or {}
        row: dict[str, Any] = {"run": name, "status": result["status"], "reason": result.get("reason")}
        rows.append(row | dict(run) | {column: figures.get(column) for column in SUMMARY})
    write_table(folder / TABLE, [{name: _cell(value) for name, value in row.items()} for row in rows])
    if parquet:
        import pyarrow
        import pyarrow.parquet

        texts = {"status", "reason"}.union(
            name for row in rows for name, value in row.items() if isinstance(value, dict | str)
        )
        table = {}
        for name in rows[0]:
            values = [_cell(row[name]) if name in texts else row[name] for row in rows]
            table[name] = pyarrow.array(values, pyarrow.string() if name in texts else None)
        with atomic(folder / PARQUET) as temporary:
            pyarrow.parquet.write_table(pyarrow.table(table), temporary)


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, str) else json.dumps(value)


def write_shards(
    folder: str | os.PathLike[str],
    runs_per_shard: int = 100,
    output: str | os.PathLike[str] | None = None,
    frames: bool = True,
    positions: bool = False,
    nodes: bool = False,
) -> list[Path]:
    """Write the complete runs of a sweep as tar files for WebDataset, into ``shards`` or another folder ``output``.

    A sample has ``json`` (``run``, ``settings``, ``summary``, and ``parameter_names``), ``parameters.npy`` (its values
    on the axes, float64, shape (A,), without text and lists of different lengths), and, if wanted, its pictures
    ``00000.png`` and so on, ``positions.npy`` of its particles [m, z up], float32, shape (T, P, 3), and ``nodes.npy``,
    displacement of the nodes that the Gaussians follow [m, z up], float32, shape (T, N, 3). The same runs give the same
    bytes.

    Raises:
        ValueError: If the folder is not a sweep, none of its runs is complete, or something was not recorded.
    """
    import webdataset

    check_whole("runs_per_shard", runs_per_shard, 1)
    folder = Path(folder)
    runs = {f"{number:05d}": run for number, run in enumerate(read_record(folder)["runs"])}
    ended = read_results(folder, runs)
    done = {name: result["figures"] for name, result in ended.items() if result["status"] == "complete"}
    if not done:
        raise ValueError(f"No run of the sweep in {folder} is complete: finish it with --resume.")
    flat = {name: {axis: _numbers(value) for axis, value in runs[name].items()} for name in done}
    lengths = {axis: {len(run[axis]) for run in flat.values()} for axis in next(iter(flat.values()))}
    axes = {axis: sizes.pop() for axis, sizes in lengths.items() if len(sizes) == 1 and 0 not in sizes}
    named = [axis if size == 1 else f"{axis}.{place}" for axis, size in axes.items() for place in range(size)]

    def sample(name: str) -> dict[str, Any]:
        place, pictures = folder / RUNS / name, _pictures(folder, name)
        trajectory, motion = place / "trajectory.npz", place / "nodes.npz"
        for wanted, asked, there, setting in (
            ("frames", frames, bool(pictures), "recorder.renders with color"),
            ("positions", positions, trajectory.exists(), "recorder.trajectory: true"),
            ("nodes", nodes, motion.exists(), "recorder.nodes: true and solver.formulation: total"),
        ):
            if asked and not there:
                raise ValueError(f"{place} has no {wanted}: leave out `{wanted}`, or sweep with {setting}.")
        told = {"run": name, "settings": runs[name], "parameter_names": named, "summary": done[name]}
        values = np.array([number for axis in axes for number in flat[name][axis]])
        found: dict[str, Any] = {"__key__": name, "json": told, "parameters.npy": values}
        if frames:
            found |= {picture.name: picture.read_bytes() for picture in pictures}
        if positions:
            states = (load_trajectory(trajectory, frame)[0].numpy() for frame in range(int(done[name]["frames"])))
            found["positions.npy"] = np.stack(list(states))
        if nodes:
            found["nodes.npy"] = load_nodes(motion).numpy()
        return found

    target = folder / SHARDS if output is None else Path(output)
    target.mkdir(parents=True, exist_ok=True)
    made, names = [], list(done)
    for first in range(0, len(names), runs_per_shard):
        made.append(target / f"{first // runs_per_shard:06d}.tar")
        with atomic(made[-1]) as temporary, temporary.open("wb") as file, webdataset.TarWriter(file, mtime=0) as tar:
            for name in names[first : first + runs_per_shard]:
                tar.write(sample(name))
    for path in target.glob("[0-9]" * 6 + ".tar"):  # of a sweep with fewer complete runs or smaller shards
        if path not in made:
            path.unlink()
    return made


def _numbers(value: Any) -> list[float]:
    found = np.asarray(value, dtype=object).ravel().tolist()
    return list(map(float, found)) if all(isinstance(item, Real) for item in found) else []


def _pictures(folder: Path, run: str) -> list[Path]:
    return sorted((folder / RUNS / run / "frames").glob("[0-9]*.png"))


def write_contact_sheet(folder: Path, plan: Plan, results: Mapping[str, Any]) -> None:
    """Write ``contact_sheet.png``: the last frame of each run, of the first 200, above its values."""
    shown = dict(zip(plan.names[:MOST_SHOWN], plan.runs, strict=False))
    across = max(1, round(math.sqrt(1.2 * len(shown))))
    side, step = WIDTH + GAP, HEIGHT + BAND + GAP
    sheet = Image.new("RGB", (across * side + GAP, -(-len(shown) // across) * step + GAP), (24, 24, 24))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for number, (name, run) in enumerate(shown.items()):
        left, top = GAP + number % across * side, GAP + number // across * step
        status = results.get(name, {"status": "missing"})["status"]
        if status == "complete" and (pictures := _pictures(folder, name)):
            with Image.open(pictures[-1]) as picture:
                sheet.paste(ImageOps.contain(picture.convert("RGB"), (WIDTH, HEIGHT)), (left, top))
        values = ", ".join(f"{axis.rpartition('.')[2]} {json.dumps(value)}" for axis, value in run.items())
        draw.text((left + 3, top + HEIGHT + 2), f"{name} {status}\n{values[:40]}", font=font)
    with atomic(folder / "contact_sheet.png") as temporary:
        sheet.save(temporary)
