"""What ``bench.py pareto`` sweeps: speed against error, for the bar, the cantilever, the hinged plate and the flag."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from bench.case import Case, Measurement, names
from bench.clock import guarded
from bench.problems import bars, beams, flags, plates
from bench.problems.settings import Settings
from bench.record import Row

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
            about: Row = {"size": size, "variant": variant, "dtype": "float32", "cfl": 0.4, "substep": None}
            for cfl in CFLS:
                if problem in ("cantilever", "hinged plate") and cfl < 0.4 and not (coarse and device == "cpu"):
                    continue  # tens of thousands of substeps, for an error that hardly depends on the substep
                yield about | {"cfl": cfl}, replace(base, cfl=cfl)
            if device == "cpu" or coarse or problem in ("bar", "flag"):
                yield about | {"dtype": "float64"}, replace(base, dtype=torch.float64)
            if fixed and variant == "total":
                yield about | {"cfl": None, "substep": fixed}, replace(base, substep=fixed)


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


def _measured(problem: str, size: float, settings: Settings, reference: Tensor | None) -> Row:
    result = run_problem(problem, size, settings, reference)
    error = abs(result["error"])
    row = {"error": error if math.isfinite(error) else None, "substeps": result["substeps"]}
    row["wall_per_simulated_s"] = result["wall_s"] / result["simulated_s"]
    return row | {k: result[k] for k in ("torn", "lost") if k in result}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Sweep the problems; a run that fails is recorded with its message and without an error."""
    device, wanted = options.device, options.only
    result["kind"], result["threads"] = device, torch.get_num_threads()
    result["rows"] = [row for row in result.get("rows", []) if row["problem"] not in wanted]
    for problem in wanted:
        reference = None
        if problem == "flag":
            exact = Settings(cfl=REFERENCE_CFL, device=device)
            _, reference = flags.flag(REFERENCE_DX, exact, **FLAG)  # type: ignore[arg-type]
        for number, (parameters, settings) in enumerate(settings_of(problem, device)):
            if number == 0:  # warm up
                run_problem(problem, parameters["size"], settings, reference)
            work = partial(_measured, problem, parameters["size"], settings, reference)
            yield ("rows", {"problem": problem} | parameters), lambda work=work: {"error": None} | guarded(work)


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


CASE = Case(
    "Measure speed against error over the settings of the solver.",
    rows,
    (names("--only", PROBLEMS),),
    page="validation.md",
    keeps="any",
)
