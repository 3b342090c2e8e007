"""The folder of a sweep: its description, the result of every run, and the table of all.

``sweep.json`` describes the sweep. ``results/00000.json`` is written when a run has ended and all its files are on
disk; with it the run counts as done. ``sweep.csv`` is made from the results, so it is the same however they came about.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaussian_swaying._files import atomic, remove_temporaries, write_json, write_table
from gaussian_swaying._inputs import read_json
from gaussian_swaying.recording.checkpoint import first_change
from gaussian_swaying.runs.folder import hold_folder
from gaussian_swaying.runs.lock import FolderLock
from gaussian_swaying.sweeps.plan import Plan

SWEEP, TABLE, PARQUET = "sweep.json", "sweep.csv", "sweep.parquet"
RUNS, RESULTS, LOGS = "runs", "results", "logs"
OURS = (SWEEP, TABLE, PARQUET, RUNS, RESULTS, LOGS)
FIGURES = (
    *("frames", "substeps", "simulated_s", "particles", "gaussians", "mass_kg", "patch_area_m2"),
    *("displacement_mean_max_m", "wind_work_J", "largest_cfl", "stretch_min", "stretch_max"),
    *("lost_particles", "torn_particles"),
)
"""Entries of ``summary.json`` in the table; none of them is a time of the clock."""

ENERGIES = ("kinetic", "elastic", "potential")
SUMMARY = (*FIGURES, *(f"{name}_end_J" for name in ENERGIES), "warnings")
"""Columns of the table after the axes."""


def open_folder(folder: Path, plan: Plan, resume: bool, together: int = 1) -> FolderLock:
    """Make and lock the folder of a sweep, or lock the one that is continued.

    Returns:
        The lock, to be released at the end.
    """
    import yaml

    held, foreign = (folder / SWEEP).exists(), [name for name in OURS if os.path.lexists(folder / name)]
    if resume and not held:
        raise ValueError(f"There is nothing to resume in {folder}: it has no {SWEEP}; leave out --resume.")
    if foreign and not resume:
        what = (
            "holds a sweep already: add --resume to do what is missing in it"
            if held
            else f"contains {foreign[0]} of something else"
        )
        raise ValueError(f"The output folder {folder} {what}: choose another --output.")
    new = {
        "made_by": "gaussian_swaying",
        "format": 1,
        "frames": plan.frames,
        "runs": [dict(run) for run in plan.runs],
        "splats": dict(plan.splats),
        "config": yaml.safe_load(plan.config),
    }
    new = dict(json.loads(json.dumps(new | ({"together": together} if together > 1 else {}))))  # as it is read again
    if held:
        _check_same(folder, new)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be written ({error.strerror}): choose another --output.") from error
    lock = hold_folder(folder, "choose another with --output")
    try:
        remove_temporaries(folder)  # of a sweep that was killed while writing
        if not held:
            write_json(folder / SWEEP, new)
        for name in (RUNS, RESULTS, LOGS):
            (folder / name).mkdir(exist_ok=True)
    except BaseException:
        lock.release()
        raise
    return lock


def read_record(folder: Path) -> dict[str, Any]:
    """``sweep.json`` of a folder: the shared configuration, frames, and the value of every axis in each run."""
    if not (folder / SWEEP).is_file():
        raise ValueError(f"{folder} is not the folder of a sweep: it has no {SWEEP}; check the path.")
    record = read_json(folder / SWEEP, "record of the sweep")
    if not isinstance(record, dict) or not isinstance(record.get("runs"), list) or not record["runs"]:
        raise ValueError(f"{folder / SWEEP} lists no runs: it is damaged; start the sweep again in another folder.")
    return record


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
        result["status"].lower()
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} is damaged ({error}): remove it, and --resume does its run again.") from error
    return dict(result)


def result_of(summary: Mapping[str, Any], attempt: int, where: str) -> dict[str, Any]:
    """The result of a complete run."""
    figures = {name: summary.get(name) for name in FIGURES}
    end = summary.get("energy_end_J") or {}
    figures |= {f"{name}_end_J": end.get(name) for name in ENERGIES}
    figures["warnings"] = len(summary.get("warnings") or ())
    result = {"status": summary["status"], "reason": None, "figures": figures, "attempts": attempt, "where": where}
    return result | {name: summary.get(name) for name in ("wall_s", "peak_memory_bytes")}


def failure(status: str, reason: str, attempt: int) -> dict[str, Any]:
    """The result of a run that is ``failed`` or ``diverged``, with one sentence why."""
    return {"status": status, "reason": reason, "attempts": attempt}


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
        for row in rows:
            row |= {name: _cell(row[name]) for name in texts}
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        kinds = {name: pyarrow.string() if name in texts else None for name in columns}
        table = pyarrow.table({name: pyarrow.array(values, kinds[name]) for name, values in columns.items()})
        with atomic(folder / PARQUET) as temporary:
            pyarrow.parquet.write_table(table, temporary)


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, str) else json.dumps(value)
