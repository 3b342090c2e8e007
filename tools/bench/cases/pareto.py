"""What ``bench.py pareto`` sweeps: speed against error, for the bar, the cantilever, the hinged plate and the flag."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench import record
from bench.problems import bars, beams, flags, plates
from bench.problems.settings import Settings

Row = dict[str, Any]

# per problem: sizes from coarse to fine, their unit, and the fixed substep [s]: PhysGaussian's for the flag, and about
# what the finest grid needs for the others
PROBLEMS: dict[str, tuple[tuple[float, ...], str, float]] = {
    "bar": ((8, 16, 32, 64), "cells along the bar", 0.4 * 25 / 64 / 11.6),
    "cantilever": ((1, 2, 3, 4), "cells through the thickness", 0.0),
    "hinged plate": ((4, 6, 8, 12), "cells along the plate", 5e-4),
    "flag": ((0.16, 0.08, 0.0533, 0.04), "dx [m]", 1e-4),
}
FLAG = {"frames": 15, "spacing": 0.02}
REFERENCE_DX, REFERENCE_CFL = 0.0267, 0.1
FORMULATIONS = {"total": ("total", False), "updated": ("updated", False), "MLS": ("updated", True)}
CFLS = (0.1, 0.2, 0.4, 0.8)
DEFAULT = {"variant": "total", "dtype": "float32", "cfl": 0.4, "substep": None}
PROVEN_CFL = 0.47  # stable for every arrangement of particles and every Poisson's ratio (mpm/timestep.py)


def settings_of(problem: str, device: str) -> Iterator[tuple[Row, Settings]]:
    """The settings to sweep for a problem: every CFL number in float32, the default in float64, a fixed substep."""
    sizes, _, fixed = PROBLEMS[problem]
    for size in sizes:
        for variant, (formulation, mls) in FORMULATIONS.items():
            base = Settings(formulation=formulation, mls=mls, dtype=torch.float32, device=device)
            coarse = size in sizes[:2]
            for cfl in CFLS:
                if problem in ("cantilever", "hinged plate") and cfl < 0.4 and not (coarse and device == "cpu"):
                    continue  # tens of thousands of substeps, for an error that hardly depends on the substep
                yield (
                    {"size": size, "variant": variant, "dtype": "float32", "cfl": cfl, "substep": None},
                    replace(base, cfl=cfl),
                )
            if device == "cpu" or coarse or problem in ("bar", "flag"):
                yield (
                    {"size": size, "variant": variant, "dtype": "float64", "cfl": 0.4, "substep": None},
                    replace(base, dtype=torch.float64),
                )
            if fixed and variant == "total":
                yield (
                    {"size": size, "variant": variant, "dtype": "float32", "cfl": None, "substep": fixed},
                    replace(base, substep=fixed),
                )


def run_problem(problem: str, size: float, settings: Settings, reference: Tensor | None) -> dict[str, float]:
    """One run; its ``error`` is relative, except for the hinged plate, where it is in degrees."""
    if problem == "bar":
        return bars.vibrating_bar(int(size), settings)
    if problem == "cantilever":
        return beams.cantilever(int(size), settings, slenderness=6)
    if problem == "hinged plate":
        return plates.hinged_plate(0.5, "projected", settings, cells=int(size), seconds=2.4, per_cell=3)
    result, series = flags.flag(size, settings, **FLAG)  # type: ignore[arg-type]
    assert reference is not None
    return result | {"error": flags.distance(series, reference)}


def measure(device: str, only: list[str] | None = None) -> list[Row]:
    """Sweep the problems; a run that fails is recorded with its message and an infinite error."""
    rows = []
    for problem in only or PROBLEMS:
        reference = None
        if problem == "flag":
            exact = Settings(cfl=REFERENCE_CFL, device=device)
            _, reference = flags.flag(REFERENCE_DX, exact, **FLAG)  # type: ignore[arg-type]
        first = True
        for parameters, settings in settings_of(problem, device):
            if first:  # warm up
                run_problem(problem, parameters["size"], settings, reference)
                first = False
            row: Row = {"problem": problem} | parameters
            try:
                result = run_problem(problem, parameters["size"], settings, reference)
                row |= {"error": abs(result["error"]), "substeps": result["substeps"]}
                row["wall_per_simulated_s"] = result["wall_s"] / result["simulated_s"]
                row["error"] = row["error"] if math.isfinite(row["error"]) else None
                row |= {k: result[k] for k in ("torn", "lost") if k in result}
            except Exception as error:
                row |= {"error": None, "failed": f"{type(error).__name__}: {error}"}
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def front(rows: list[Row]) -> list[Row]:
    """The rows that no other row beats in both error and time, cheapest first."""
    good = sorted((r for r in rows if r["error"]), key=lambda r: (r["wall_per_simulated_s"], r["error"]))
    kept: list[Row] = []
    for row in good:
        if not kept or row["error"] < kept[-1]["error"]:
            kept.append(row)
    return kept


def is_default(row: Row) -> bool:
    """Whether a row used the default settings of the solver, on any grid."""
    return all(row[name] == value for name, value in DEFAULT.items())


def proven(row: Row) -> bool:
    """Whether the substep of a row is short enough for any arrangement of particles."""
    return row["cfl"] is None or row["cfl"] <= PROVEN_CFL


def on_front(row: Row, rows: list[Row], noise: float = 0.1) -> bool:
    """Whether no other row is as accurate and cheaper by more than the noise of the clock (a share)."""
    return not any(
        other["error"]
        and other["error"] <= row["error"]
        and other["wall_per_simulated_s"] < row["wall_per_simulated_s"] * (1 - noise)
        for other in rows
    )


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py pareto``."""
    command.add_argument("--only", help="only the problems with these names, separated by commas")


def run(options: argparse.Namespace) -> None:
    """Measure speed against error over the settings of the solver."""
    device, result = record.start(options.device)
    result["kind"], result["threads"] = device.type, torch.get_num_threads()
    folder, name = Path(options.results), f"pareto_{device.type}"
    wanted = options.only.split(",") if options.only else None
    record.keep_rows(result, folder, name, lambda row: bool(wanted) and row["problem"] not in wanted)
    result["rows"] += measure(device.type, wanted)
    record.write(folder, name, result)
