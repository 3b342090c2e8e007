"""``bench.py folds``: flag 1, which folds onto itself, with and without contact, compared with other cloth solvers."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import torch

from bench.case import FRAMES, POINTS, Case, Measurement, names, option
from bench.cases import flags, pins
from bench.problems.contacts import crossings, sheet_triangles
from bench.record import Row
from bench.simulate import simulate
from gaussian_swaying.evaluation.compare import compare_run
from gaussian_swaying.recording.trajectory import load_trajectory

PATTERN = 1
DISTANCE = 0.005
"""Distance that the cloth keeps from itself, in all solvers [m]."""

REFERENCES = {
    "blender": "Blender, no contact",
    "blender_contact": "Blender, contact",
    "newton": "Newton, no contact",
    "newton_contact": "Newton, contact",
}
"""Folders of the references, and their titles."""


@dataclass(frozen=True)
class Fold:
    """One of our rows.

    Attributes:
        contact: Whether the flag touches itself.
        dx: Grid spacing [m].
    """

    contact: bool
    dx: float

    def title(self) -> str:
        """The name in the tables."""
        return f"ours, {'contact' if self.contact else 'no contact'}, dx = {self.dx:g} m"


ROWS = {
    f"{name}{suffix}": Fold(contact, dx)
    for suffix, dx in (("_04", 0.04), ("_03", 0.03), ("_02", 0.02), ("_015", 0.015))
    for name, contact in (("free", False), ("contact", True))
}
"""All rows, by name."""

CROSSED = (249,)
"""Frames in which crossings are counted."""

LATTICE = 3
"""Every third Gaussian of the flag is a corner of the triangles whose crossings are counted."""


def arguments(fold: Fold) -> list[str]:
    """Command line of tools/sim.py for a row."""
    variant = pins.variant(pins.Pin("hinge", fold.dx), PATTERN)
    own = flags.sim_arguments(PATTERN, variant, Path("none"), None)
    return [*own, f"--contact.thickness={DISTANCE}", "--contact.friction=0"] if fold.contact else own


def folder_crossings(run: Path, frames: tuple[int, ...]) -> list[int]:
    """How often triangles between Gaussians of the flag cross each other in some frames of a run."""
    flag = flags.REFERENCES[PATTERN]
    spacing = 0.00625  # of the Gaussians, see configs/bench/flag1.yaml
    nx, ny = round(flag.width / spacing), round(flag.height / spacing)
    found = []
    for frame in frames:
        place, _ = load_trajectory(run / "trajectory.npz", frame)
        lattice = place[: nx * ny].reshape(nx, ny, 3)[::LATTICE, ::LATTICE]
        found.append(crossings(lattice.reshape(-1, 3), sheet_triangles(*lattice.shape[:2])))
    return found


def reference_frames(path: Path) -> int:
    """How many frames a reference has."""
    with np.load(path) as found:
        return len(found["positions"])


def run_row(fold: Fold, options: argparse.Namespace) -> Row:
    """Simulate a row and compare it with each reference."""
    with tempfile.TemporaryDirectory() as scratch:
        return _compared(fold, Path(options.dataset), options, Path(scratch) / "run")


def _compared(fold: Fold, dataset: Path, options: argparse.Namespace, output: Path) -> Row:
    bare = ["--recorder.images=false", "--recorder.video=false"]
    summary = simulate([*arguments(fold), *bare], output, options.device, options.frames)
    if "failed" in summary:
        return summary
    frames = summary["frames"]
    row: Row = {key: summary[key] for key in ("status", "particles", "frames", "substeps", "torn_particles")}
    row["ms_per_frame"] = 1e3 * summary["wall_s"].get("simulation", 0.0) / max(frames, 1)
    row["to"] = {}
    for name in REFERENCES:
        if (dataset / name / f"pattern{PATTERN}" / "cloth.npz").exists():
            bare = output.parent / name  # the surface alone
            bare.mkdir(exist_ok=True)
            if not (bare / "cloth.npz").exists():
                source = dataset / name / f"pattern{PATTERN}" / "cloth.npz"
                (bare / "cloth.npz").symlink_to(source.resolve())
            shown = min(frames, reference_frames(bare / "cloth.npz"))
            found = compare_run(output, bare, frames=shown, points=options.points, device=options.device)
            row["to"][name] = {key: found[key] for key in ("chamfer_share", "sampling_m")} | {"frames": shown}
    row["crossings"] = folder_crossings(output, tuple(f for f in CROSSED if f < frames))
    return row


def describe(dataset: Path) -> Row:
    """The references: mesh and steps, uncertainty, crossings, and how far they are from each other."""
    from flag_difference import difference
    from flag_motion import read_cloth

    known, motions = {}, {}
    for name in REFERENCES:
        folder = dataset / name / f"pattern{PATTERN}"
        if not (folder / "cloth.npz").exists():
            continue
        motions[name] = motion = read_cloth(folder / "cloth.npz")
        triangles = torch.from_numpy(np.concatenate([motion.faces[:, [0, 1, 2]], motion.faces[:, [0, 2, 3]]])).long()
        shown = [f for f in CROSSED if f < len(motion.positions)]
        known[name] = {
            "cells": motion.settings["cells"],
            "quality": motion.settings["quality"],
            "frames": len(motion.positions),
            "crossings": [crossings(torch.from_numpy(motion.positions[f]), triangles) for f in shown],
        }
        path = folder / "uncertainty.json"
        if path.exists():
            rows = json.loads(path.read_text())["variants"]
            keep = ("cells", "quality", "chamfer", "frames_compared")
            known[name]["uncertainty"] = {n: {k: v[k] for k in keep} for n, v in rows.items()}
    pattern = flags.REFERENCES[PATTERN]
    apart = {}
    for a, b in combinations(motions, 2):
        most = min(len(motions[a].positions), len(motions[b].positions))
        one, other = (replace(motions[name], positions=motions[name].positions[:most]) for name in (a, b))
        apart[f"{a} {b}"] = difference(pattern, one, other, every=25)["chamfer"]
    return {"distance_m": DISTANCE, "references": known, "apart": apart}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Describe the references, and compare each row with them."""
    known = describe(Path(options.dataset))
    if not known["references"]:
        told = "see docs/contact.md for how they are made"
        raise SystemExit(f"{options.dataset} has none of {', '.join(REFERENCES)}: {told}")
    result.update(known)
    yield from ((("rows", name), partial(run_row, ROWS[name], options)) for name in options.rows)


CASE = Case(
    "Compare a flag that folds onto itself with other cloth solvers, with and without contact.",
    rows,
    (
        option("--dataset", f"folder with the references {', '.join(REFERENCES)}, each written by "
               "tools/datasets/make_flag_dataset.py", required=True),
        names("--rows", ROWS, default=("free_04", "contact_04")),
        FRAMES,
        POINTS,
    ),
    page="contact.md",
)  # fmt: skip
