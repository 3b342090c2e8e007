"""What ``bench.py area`` measures: areas of bodies with a known skin, of captures, and the time that they take."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench import record
from bench.problems.bodies import BODIES, area_shares, cluttered_sphere, of_cloud
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.geometry.directions import hull_area

Row = dict[str, Any]

TIMED = 150_000  # Gaussians of the body that is timed
REPEATS = 3


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py area``."""
    command.add_argument("--body", action="append", choices=list(BODIES), help="only this one; repeatable")
    command.add_argument("--ply", action="append", default=[], help="a captured splat, without known area; repeatable")
    command.add_argument("--timed", type=int, default=TIMED, help="Gaussians of the body that is timed")


def run(options: argparse.Namespace) -> None:
    """Measure on the CPU, where areas are computed on every machine."""
    _, result = record.start("cpu")
    record.go_on(options, "area_cpu", result, measure)


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result["bodies"]``, ``["timed"]`` and ``["captures"]``, saving it after each row."""
    rows = result.setdefault("bodies", {})
    for name in options.body or BODIES:
        body = BODIES[name]()
        rows[name] = area_shares(body) | {"known": body.area is not None}
        print(f"{name}: coverage {rows[name]['coverage']:.3f}, open {rows[name]['open']:.3f}", flush=True)
        save(result)
    if options.timed:
        timed = [area_shares(cluttered_sphere(options.timed)) for _ in range(REPEATS)]
        result["timed"] = min(timed, key=lambda row: row["open_s"])
        print(f"{options.timed:,} Gaussians: {result['timed']['open_s']:.2f} s", flush=True)
        save(result)
    for file in options.ply:
        body = of_cloud(read_gaussians(file))
        row = area_shares(body) | {"hull": hull_area(body.means)}
        result.setdefault("captures", {})[Path(file).stem] = row
        print(f"{Path(file).stem}: open {row['open']:.3f} of coverage", flush=True)
        save(result)
