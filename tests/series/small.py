"""A small splat and a small run, which the cases spoil."""

from __future__ import annotations

import functools
import json
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
FLAG = ROOT / "configs/sim/flag.yaml"
PIN = [{"class_path": "PinnedRegion", "init_args": {"region": {
    "class_path": "Box", "init_args": {"min": [None, None, None], "max": [0.11, None, None]}}}}]  # fmt: skip
SMALL = ["--config", str(FLAG), "--frames", "2", "--device", "cpu", "--scene.generator.init_args.spacing", "0.1"]
SMALL += ["--solver.dx", "0.2", "--solver.boundaries", json.dumps(PIN), "--output", "run"]
SMALL += ["--camera.init_args.width", "32", "--camera.init_args.height", "18"]


@functools.cache
def splat_bytes() -> bytes:
    """A flag of 96 Gaussians as a .ply file."""
    from gaussian_swaying.gaussians.ply import write_ply
    from gaussian_swaying.scenes.procedural import FlagScene

    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "flag.ply", FlagScene(spacing=0.1).generate())
        return (Path(folder) / "flag.ply").read_bytes()
