"""The motion of a flag: settings, solving, and the file that holds it."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from blender_cloth import solve_cloth
from flag_reference import FlagPattern

from gaussian_swaying._files import atomic
from gaussian_swaying._inputs import read_arrays

UNITS = {
    "positions": "m",
    "rest_normals": "1",
    "uv": "1",
    "pin_uv": "1",
    "fps": "1/s",
    "areal_density": "kg/m^2",
    "membrane_stiffness": "N/m",
    "bending_stiffness": "N m",
    "youngs_modulus": "Pa",
    "density": "kg/m^3",
    "thickness": "m",
    "gravity": "m/s^2",
    "flow": "m/s",
    "air_density": "kg/m^3",
    "pressure": "Pa",
    "damping": "1/s",
}


def settings_hash(settings: dict[str, Any]) -> str:
    """Hash of the settings, independent of their order."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def check_settings(where: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Raise a ValueError that names each setting of the output ``where`` that differs from ``wanted``."""
    wanted = json.loads(json.dumps(wanted))  # tuples become lists
    changed = [
        f"`{name}` was {found.get(name)!r} and is now {wanted.get(name)!r}"
        for name in sorted(found.keys() | wanted.keys())
        if found.get(name) != wanted.get(name)
    ]
    if changed:
        raise ValueError(
            f"{where} was made with other settings: {'; '.join(changed)}. Give another `--out`, the old settings, or "
            "remove it."
        )


@dataclass(frozen=True, eq=False)
class Cloth:
    """The motion of a flag.

    Attributes:
        positions: Vertices at each frame [m], float32, shape (F, V, 3).
        faces: Squares as indices of vertices, with normals on the camera's side; shape (Q, 4).
        uv: Position of each vertex on the flag, in 0 to 1, (V, 2). Vertex i (rows + 1) + j is the j-th of column i.
        settings: Fields of the :class:`FlagPattern` that determine the motion.
    """

    positions: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    columns: int
    rows: int
    settings: dict[str, Any]


def solve_pattern(pattern: FlagPattern, path: Path, report: Callable[[int], None] | None = None) -> bool:
    """Solve a flag and write its motion, unless the file exists.

    Returns:
        Whether it was solved.
    """
    settings = pattern.cloth_settings()
    if path.exists():
        check_settings(path, read_cloth(path).settings, settings)
        return False
    grid, material, run = pattern.grid(), pattern.material(), pattern.run()
    uv = grid.uv()
    rest, normals = pattern.rest(uv)
    pins = pattern.pins(uv)
    positions = solve_cloth(grid, rest, pins, material, run, report)
    arrays: dict[str, Any] = {
        "positions": positions,
        "faces": grid.faces().astype(np.int32),
        "uv": uv,
        "columns": grid.columns,
        "rows": grid.rows,
        "rest_normals": normals,
        "pins": pins,
        "pin_uv": pattern.pin_uv(),
        "fps": run.fps,
        "areal_density": material.areal_density,
        "membrane_stiffness": material.membrane,
        "bending_stiffness": material.bending,
        "youngs_modulus": pattern.youngs_modulus,
        "poisson_ratio": pattern.poisson_ratio,
        "density": pattern.density,
        "thickness": pattern.thickness,
        "gravity": np.array([0.0, 0.0, -pattern.gravity]),
        "flow": np.array(run.flow),
        "air_density": pattern.air_density,
        "drag": pattern.drag,
        "damping": pattern.damping,
        "pressure": run.pressure,
        "units": json.dumps(UNITS),
        "settings": json.dumps(settings),
        "hash": settings_hash(settings),
    }

    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        np.savez_compressed(temporary, **arrays)
    return True


def read_cloth(path: str | os.PathLike[str]) -> Cloth:
    """Read a motion."""
    found = read_arrays(path, "the motion of a flag", ("positions", "faces", "uv", "columns", "rows", "settings"))
    positions, faces, uv = (found[name] for name in ("positions", "faces", "uv"))
    return Cloth(positions, faces, uv, int(found["columns"]), int(found["rows"]), json.loads(str(found["settings"])))
