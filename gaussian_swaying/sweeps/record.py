"""The folder of a sweep: its description, the result of every run, and the table of all.

``sweep.json`` describes the sweep. ``results/00000.json`` is written when a run has ended and all its files are on
disk; with it the run counts as done. ``sweep.csv`` is made from the results, so it is the same however they came about.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gaussian_swaying._files import atomic, remove_temporaries, write_json, write_table
from gaussian_swaying._inputs import read_json
from gaussian_swaying.recording.checkpoint import first_change
from gaussian_swaying.runs.folder import hold_folder
from gaussian_swaying.runs.lock import FolderLock
from gaussian_swaying.sweeps.plan import Plan

SWEEP, TABLE, TIMES = "sweep.json", "sweep.csv", "times.csv"
PARQUET = "sweep.parquet"
RUNS, RESULTS, LOGS, SHARES = "runs", "results", "logs", "parts"
OURS = (SWEEP, TABLE, TIMES, PARQUET, RUNS, RESULTS, LOGS)
FIGURES = (
    "frames",
    "substeps",
    "simulated_s",
    "particles",
    "gaussians",
    "mass_kg",
    "patch_area_m2",
    "displacement_mean_max_m",
    "wind_work_J",
    "largest_cfl",
    "stretch_min",
    "stretch_max",
    "lost_particles",
    "torn_particles",
)
"""Entries of ``summary.json`` in the table; none of them is a time of the clock."""

ENERGIES = ("kinetic", "elastic", "potential")
PARTS = ("startup", "simulation", "shading", "rendering", "writing")
SUMMARY = (*FIGURES, *(f"{name}_end_J" for name in ENERGIES), "warnings")
"""Columns of the table after the axes."""


def open_folder(
    folder: Path, plan: Plan, resume: bool, together: int = 1, part: tuple[int, int] | None = None
) -> FolderLock:
    """Make and lock the folder of a sweep, or lock the one that is continued.

    Args:
        folder: The folder.
        plan: The sweep.
        resume: Whether to continue the sweep in it.
        together: Largest number of runs that are simulated together, on which the results depend.
        part: Number of a part and how many there are. Other processes do the others in the same folder: only the part
            is locked then, and it does not matter whether the sweep has begun.

    Returns:
        The lock, to be released at the end.
    """
    foreign = [name for name in OURS if os.path.lexists(folder / name)]  # before `held`, as another part may begin
    held = (folder / SWEEP).exists()
    if resume and not held and part is None:
        raise ValueError(f"There is nothing to resume in {folder}: it has no {SWEEP}; leave out --resume.")
    if held and not resume and part is None:
        raise ValueError(
            f"{folder} holds a sweep already: add --resume to do what is missing in it, or choose another --output."
        )
    if foreign and not held:
        raise ValueError(
            f"The output folder {folder} contains {', '.join(foreign)} of something else: choose another --output."
        )
    new = _described(plan) | ({"together": together} if together > 1 else {})
    if held:
        _check_same(folder, new)
    own = folder if part is None else folder / SHARES / f"{part[0]}of{part[1]}"
    try:
        own.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"The output folder {folder} cannot be written ({error.strerror or error}): choose another with --output."
        ) from error
    lock = hold_folder(own, "choose another with --output" if part is None else "wait for that part")
    try:
        remove_temporaries(own)  # of a sweep that was killed while writing
        if not held:
            _begin(folder, own, new)
        for name in (RUNS, RESULTS, LOGS):
            (folder / name).mkdir(exist_ok=True)
    except BaseException:
        lock.release()
        raise
    return lock


def _begin(folder: Path, own: Path, new: dict[str, Any]) -> None:
    """Write ``sweep.json``; of several parts that begin at the same moment, the first one does."""
    write_json(own / SWEEP, new)
    if own != folder:
        try:
            os.link(own / SWEEP, folder / SWEEP)
        except FileExistsError:
            _check_same(folder, new)
        except OSError:  # a file system without links
            os.replace(own / SWEEP, folder / SWEEP)


def read_record(folder: Path) -> dict[str, Any]:
    """``sweep.json`` of a folder: the shared configuration, frames, and the value of every axis in each run."""
    if not (folder / SWEEP).is_file():
        raise ValueError(f"{folder} is not the folder of a sweep: it has no {SWEEP}; check the path.")
    record = read_json(folder / SWEEP, "record of the sweep")
    if not isinstance(record, dict) or not isinstance(record.get("runs"), list) or not record["runs"]:
        raise ValueError(f"{folder / SWEEP} lists no runs: it is damaged; start the sweep again in another folder.")
    return record


def _described(plan: Plan) -> dict[str, Any]:
    import yaml

    described = {
        "made_by": "gaussian_swaying",
        "format": 1,
        "frames": plan.frames,
        "runs": [dict(run) for run in plan.runs],
        "splats": dict(plan.splats),
        "config": yaml.safe_load(plan.config),
    }
    return dict(json.loads(json.dumps(described)))  # as it is read again


def _check_same(folder: Path, new: dict[str, Any]) -> None:
    old = read_record(folder)
    if old == new:
        return
    what = f"it has {len(old['runs'])} runs, and now there are {len(new['runs'])}"
    if len(old["runs"]) == len(new["runs"]):
        what = first_change(json.dumps(old), json.dumps(new)).removeprefix("`config.")
        what = f"`{what}" if not what.startswith(("`", "in")) else what
    raise ValueError(f"{folder} holds a sweep with other settings ({what}): restore them, or choose another --output.")


# ---- results
def result_file(folder: Path, name: str) -> Path:
    """The result of a run."""
    return folder / RESULTS / f"{name}.json"


def read_result(folder: Path, name: str) -> dict[str, Any] | None:
    """The result of a run; None if it has not ended."""
    path = result_file(folder, name)
    if not path.exists():
        return None
    try:
        result = read_json(path, "result")
        if isinstance(result, dict) and isinstance(result.get("status"), str):
            return result
        why = "it has no status"
    except ValueError as error:
        why = str(error).rstrip(".")
    raise ValueError(f"{path} is damaged ({why}): remove it, and --resume does its run again.")


def result_of(summary: Mapping[str, Any], attempt: int, where: str = "") -> dict[str, Any]:
    """The result of a complete run.

    Args:
        summary: Its summary, as in ``summary.json``.
        attempt: Number of times that it was begun in this sweep.
        where: The machine that did it.
    """
    figures = {name: summary.get(name) for name in FIGURES}
    end = summary.get("energy_end_J") or {}
    figures |= {f"{name}_end_J": end.get(name) for name in ENERGIES}
    figures["warnings"] = len(summary.get("warnings") or ())
    return {
        "status": summary["status"],
        "reason": None,
        "figures": figures,
        "attempts": attempt,
        "where": where,
        "wall_s": summary.get("wall_s"),
        "peak_memory_bytes": summary.get("peak_memory_bytes"),
    }


def failure(status: str, reason: str, attempt: int) -> dict[str, Any]:
    """The result of a run that failed.

    Args:
        status: ``failed`` or ``diverged``.
        reason: One sentence.
        attempt: Number of times that it was begun.
    """
    return {"status": status, "reason": reason, "attempts": attempt}


# ---- tables
def write_tables(
    folder: Path, names: Sequence[str], runs: Sequence[Mapping[str, Any]], results: Mapping[str, Any]
) -> None:
    """Write ``sweep.csv``, a row per run in their order, and ``times.csv`` with what differs from machine to machine.

    Args:
        folder: Folder of the sweep.
        names: Names of the runs.
        runs: The value of every axis in each run.
        results: Result of each run that has one, by name.
    """
    table, times = [], []
    for name, run in zip(names, runs, strict=True):
        result = results.get(name) or {"status": "missing", "reason": None}
        figures = result.get("figures") or {}
        row = {"run": name, "status": result["status"], "reason": result.get("reason")}
        row |= {axis: _cell(value) for axis, value in run.items()}
        table.append(row | {column: _cell(figures.get(column)) for column in SUMMARY})
        walls, peak = result.get("wall_s") or {}, result.get("peak_memory_bytes") or {}
        clock = {"run": name, "attempts": result.get("attempts"), "where": result.get("where")}
        clock |= {f"{part}_s": walls.get(part) for part in PARTS}
        times.append(clock | {f"{where}_bytes": peak.get(where) for where in ("host", "device")})
    write_table(folder / TABLE, table)
    write_table(folder / TIMES, times)


def check_parquet() -> None:
    """Raise ValueError if pyarrow is missing."""
    if find_spec("pyarrow") is None:
        raise ValueError("`--parquet` needs pyarrow: install gaussian-swaying[parquet], or use sweep.csv.")


def write_parquet(
    folder: Path, names: Sequence[str], runs: Sequence[Mapping[str, Any]], results: Mapping[str, Any]
) -> None:
    """Write ``sweep.parquet``: the rows and columns of ``sweep.csv``, with typed numbers and lists of numbers.

    Args:
        folder: Folder of the sweep.
        names: Names of the runs.
        runs: The value of every axis in each run.
        results: Result of each run that has one, by name.
    """
    import pyarrow
    import pyarrow.parquet

    ordered = [results.get(name) or {"status": "missing"} for name in names]
    columns: dict[str, list[Any]] = {"run": list(names)}
    columns |= {name: [result.get(name) for result in ordered] for name in ("status", "reason")}
    columns |= {axis: _typed([run[axis] for run in runs]) for axis in runs[0]}
    columns |= {name: _typed([(result.get("figures") or {}).get(name) for result in ordered]) for name in SUMMARY}
    text = pyarrow.schema([(name, pyarrow.string()) for name in ("status", "reason")])
    kinds = {name: text.field(name).type for name in text.names}
    arrays = {name: pyarrow.array(values, kinds.get(name)) for name, values in columns.items()}
    with atomic(folder / PARQUET) as temporary:
        pyarrow.parquet.write_table(pyarrow.table(arrays), temporary)


def _typed(values: list[Any]) -> list[Any]:
    """Values of one type: whole numbers, numbers, lists of numbers, or else text."""
    given = [value for value in values if value is not None]
    if all(type(value) is int for value in given):
        return values
    if all(type(value) in (int, float) for value in given):
        return [None if value is None else float(value) for value in values]
    if all(isinstance(v, list) and all(type(x) in (int, float) for x in v) for v in given):
        return [None if value is None else [float(x) for x in value] for value in values]
    return [_cell(value) for value in values]


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, str) else json.dumps(value)
