"""``bench.py blender``: time and error of the same flags by Blender's cloth and by ours, turn by turn."""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np
import yaml

from bench.case import NOTE, Case, Measurement, numbers, option
from bench.cases import flags, pins
from bench.cases.flags import Flag
from bench.clock import guarded
from bench.record import ROOT, Row
from bench.simulate import simulate, what_failed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.recording.trajectory import load_trajectory

from flag_difference import difference, even_uv  # isort: skip  `flags` has added the folder of the data sets
from flag_motion import Cloth, settings_hash  # isort: skip
from flag_reference import FlagPattern, least_quality  # isort: skip

REFERENCES = {"blender": 160, "ours": 100}
"""The solvers, and the cells along the longer side of their motions that all are compared with."""


def whole(width: float, height: float, spacing: float) -> float:
    """The largest spacing up to a given one that divides both sides, so that a flag made in code has its size.

    Args:
        width: One side [m].
        height: The other side [m].
        spacing: The spacing wanted [m].
    """
    for columns in range(math.ceil(width / spacing - 1e-6), math.ceil(1.2 * width / spacing)):
        rows = height * columns / width
        if abs(rows - round(rows)) < 1e-6 * rows:
            return spacing if abs(columns * spacing - width) < 1e-6 * width else width / columns
    return spacing


@dataclass(frozen=True)
class Run:
    """One solution of a flag.

    Attributes:
        pattern: The flag.
        solver: ``blender`` or ``ours``.
        cells: Cells of the cloth (of Blender), or of the grid (of ours), along the longer side.
        frames: Frames, the first being the rest shape.
    """

    pattern: Flag
    solver: str
    cells: int
    frames: int

    def place(self) -> Row:
        """What its row is known by."""
        return {"flag": self.pattern, "solver": self.solver, "cells": self.cells}

    def flag(self) -> FlagPattern:
        """The flag, on Blender's mesh with the fewest steps a frame that its bending allows."""
        flag = replace(flags.REFERENCES[self.pattern], frames=self.frames)
        if self.solver == "ours":
            return flag
        flag = replace(flag, cells=self.cells)
        return replace(flag, quality=least_quality(flag))

    def arguments(self) -> list[str]:
        """Our command line: an edge held as cloth is held, and a pressure that is linear like Blender's."""
        dx = self.flag().longer_side / self.cells
        variant = pins.variant(pins.Pin("hinge", round(dx, 6), linear=True), self.pattern)
        more = ["--recorder.images=false", "--recorder.video=false"]
        made = yaml.safe_load(flags.matched_configs(self.pattern)[-1].read_text())["scene"]["generator"]["init_args"]
        spacing = made["spacing"]
        while spacing > 0.45 * dx:  # extra points on Gaussians would make the flag heavier by a hundredth
            spacing /= 2
        spacing = whole(self.flag().width, self.flag().height, spacing)
        if spacing != made["spacing"]:
            more.append(f"--scene.generator.init_args.spacing={spacing}")
        return [*flags.sim_arguments(self.pattern, variant, Path("none"), None), *more]

    def solve(self, blender: str) -> tuple[np.ndarray, Row]:
        """Positions at each frame [m], (frames, V, 3) column by column, and counts and seconds.

        Args:
            blender: A Python that has bpy.

        Raises:
            RuntimeError: If the solver failed; the message is its own.
        """
        with tempfile.TemporaryDirectory() as folder:
            return self._by_blender(blender, Path(folder)) if self.solver == "blender" else self._by_us(Path(folder))

    def _by_blender(self, blender: str, folder: Path) -> tuple[np.ndarray, Row]:
        flag, path = self.flag(), folder / "motion.npz"
        program = str(ROOT / "tools" / "datasets" / "time_cloth.py")
        begin = time.perf_counter()
        done = subprocess.run([blender, program, json.dumps(asdict(flag)), str(path)], capture_output=True, text=True)
        process = time.perf_counter() - begin
        if done.returncode:
            raise RuntimeError(what_failed(done.stderr))
        with np.load(path) as found:
            positions, seconds = found["positions"], float(found["seconds"])
        steps = flag.quality * (flag.frames - 1)
        return positions, {"points": positions.shape[1], "steps": steps, "seconds": seconds, "process_s": process}

    def _by_us(self, folder: Path) -> tuple[np.ndarray, Row]:
        summary = simulate(self.arguments(), folder / "run", "cpu", self.frames)
        if "failed" in summary or summary["status"] != "complete":
            raise RuntimeError(summary.get("failed") or summary["reason"])
        frame, path = SimFrame.from_summary(summary), folder / "run" / "trajectory.npz"
        count = summary["simulated_gaussians"]  # extra points follow them
        places = (frame.point_to_scene(load_trajectory(path, number)[0][:count]) for number in range(self.frames))
        row = {"points": summary["particles"], "steps": summary["substeps"], "seconds": summary["wall_s"]["simulation"]}
        flag = self.flag()
        share = summary["mass_kg"] / (flag.material().areal_density * flag.width * flag.height)
        row |= {"process_s": summary["process_s"], "mass": share}
        return np.stack([place.numpy() for place in places]), row

    def cloth(self, positions: np.ndarray) -> Cloth:
        """The motion as a surface: of Blender's vertices, or of our Gaussians."""
        flag = self.flag()
        if self.solver == "blender":
            grid = flag.grid()
            return Cloth(positions, grid.faces(), grid.uv(), grid.columns, grid.rows, {})
        columns = round((positions.shape[1] * flag.width / flag.height) ** 0.5)
        rows = positions.shape[1] // columns
        axes = [(np.arange(count) + 0.5) / count for count in (columns, rows)]
        uv = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        return Cloth(positions, np.empty((0, 4), int), uv, columns - 1, rows - 1, {})


def version(python: str) -> str:
    """Blender's version in a Python; exits if that has no Blender."""
    program = "import bpy; print(bpy.app.version_string)"
    try:
        done = subprocess.run([python, "-c", program], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        told = "give one that has it with --blender, see docs/flag_dataset.md"
        raise SystemExit(f"{python} cannot import bpy: {told}") from error
    return done.stdout.splitlines()[-1].split()[0]


def reference(run: Run, options: argparse.Namespace) -> Cloth:
    """A motion to compare with: that in the folder of references, or else it is solved and put there."""
    name = f"{run.solver}_{run.pattern}_{settings_hash(asdict(run.flag()) | asdict(run))}.npz"
    path = Path(options.references) / name
    if not path.exists():
        print(f"solving {run.place()} as a reference", flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, positions=run.solve(options.blender)[0])
    with np.load(path) as found:
        return run.cloth(found["positions"])


def apart(flag: FlagPattern, one: Cloth, other: Cloth) -> Row:
    """Distances of two motions as shares of the longer side.

    Returns:
        ``chamfer``, the mean over the frames; ``same_places``, that between the same places on the cloth; and
        ``first``, the largest distance between the same places of the two shapes at rest.
    """
    found, places = difference(flag, one, other), even_uv(flag)
    rest, wanted = (replace(cloth, positions=cloth.positions[:1]).sample(places) for cloth in (one, other))
    first = float(np.linalg.norm(rest - wanted, axis=-1).max()) / flag.longer_side
    return {"chamfer": found["chamfer"], "same_places": found["corresponding"], "first": first}


def measured(run: Run, options: argparse.Namespace, known: dict[str, Cloth], row: Row) -> Row:
    """Solve a flag once more: its seconds are added to those of earlier rounds in ``row``, with their median."""
    (positions, found), flag = run.solve(options.blender), run.flag()
    if "to" not in row:
        row["to"] = {name: apart(flag, run.cloth(positions), other) for name, other in known.items()}
    times = {name: found.pop(name) for name in ("seconds", "process_s")}
    row |= found
    for name, value in times.items():
        row.setdefault(f"{name}_of_rounds", []).append(value)
        row[name] = statistics.median(row[f"{name}_of_rounds"])
    row["per_simulated_s"] = row["seconds"] * flag.fps / (run.frames - 1)
    return dict(row)


def turns(pattern: Flag, options: argparse.Namespace) -> list[Run]:
    """The solutions of a flag from coarse to fine, Blender's and ours by turns."""
    sides = [[Run(pattern, name, cells, options.frames) for cells in asked]
             for name, asked in (("blender", options.blender_cells), ("ours", options.our_cells))]  # fmt: skip
    return [run for turn in zip_longest(*sides) for run in turn if run is not None]


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """First what all are compared with, solved if it is not there; then, in rounds, both solve each flag."""
    wanted, known, told = options.flags, dict[Flag, dict[str, Cloth]](), dict[Run, Row]()
    result["versions"] = result["versions"] | {"bpy": version(options.blender)}
    result |= {"frames": options.frames, "rounds": options.rounds, "note": options.note}
    result["rows"] = [row for row in result.get("rows", []) if row["flag"] not in wanted]
    for pattern in wanted:
        asked = {name: Run(pattern, name, cells, options.frames) for name, cells in REFERENCES.items()}
        known[pattern] = {name: reference(run, options) for name, run in asked.items()}
        about = apart(asked["ours"].flag(), *known[pattern].values()) | {"cells": REFERENCES}
        yield ("references", str(pattern)), about.copy
        Run(pattern, "ours", options.our_cells[0], 2).solve(options.blender)  # so that its kernels are compiled
    for _ in range(options.rounds):
        for run in (run for pattern in wanted for run in turns(pattern, options)):
            work = partial(measured, run, options, known[run.pattern], told.setdefault(run, {}))
            yield ("rows", run.place()), partial(guarded, work)


def quickest(rows: list[Row], blender: Row, to: str) -> Row | None:
    """Of our rows of a flag, the one that is quickest among those as close to a reference as a row of Blender's."""
    close = [row for row in rows if row["flag"] == blender["flag"] and row["solver"] == "ours" and "failed" not in row
             and row["to"][to]["chamfer"] <= blender["to"][to]["chamfer"]]  # fmt: skip
    return min(close, key=lambda row: row["seconds"], default=None)


CASE = Case(
    "Compare time and error of flags with those of Blender's cloth, turn by turn.",
    rows,
    (
        option("--blender", "a Python that has bpy; it may have an environment of its own", default=sys.executable),
        option("--references", "folder of the motions to compare with; what it lacks is solved first, without a clock",
               default="outputs/blender"),
        numbers("--flags", "patterns", default="1,2,3"),
        numbers("--blender_cells", "cells along the longer side, Blender's", default="24,48,60,84,96"),
        numbers("--our_cells", "cells along the longer side, ours", default="20,30,40,60"),
        option("--frames", "frames, the first being the rest shape", type=int, default=75),
        option("--rounds", "how often each is solved", type=int, default=3),
        NOTE,
    ),
    page="benchmarks.md",
    device=False,
)  # fmt: skip
