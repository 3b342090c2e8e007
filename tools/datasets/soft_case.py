"""A soft post in wind whose wind and material are to be found from video: its truth, its splat, its configurations.

``newton_soft.py`` solves the motion, ``make_fit_data.py`` makes the data. Nothing here needs Newton or Blender.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fit_cases import FitVideo, shared_scene, shared_truth
from flag_motion import check_settings
from newton_soft import Air, Block, solve_block

from gaussian_swaying._files import atomic
from gaussian_swaying._inputs import read_arrays
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import box, to_cloud
from gaussian_swaying.scenes.printed_cloth import printed_colours

SOFT = "soft"
"""Name of the case."""

PRINT = 4.0
"""How much smaller the print is than on cloth: discs of 4 to 14 mm."""

STEP = 0.4
"""Longest step of Newton: the time in which the fastest wave crosses this share of a cell."""

SOUGHT = {
    "wind.speed": {"range": [1.0, 12.0]},
    "wind.azimuth": {"range": [-90.0, 90.0]},
    "material.E": {"range": [1e4, 8e4]},
}
"""What is to be found, with ranges."""


@dataclass(frozen=True)
class SoftPattern:
    """A post of soft foam in steady wind, held at its foot.

    Lengths are in m, ``density`` in kg/m³, moduli in Pa, ``flow`` in m/s; ``damping`` is the rate at which velocities
    decay besides what the air takes [1/s]. ``side`` is that of the square section, ``held`` the height of the foot that
    does not move. ``drag`` is the coefficient of each face: a prism across the wind has two. ``cells`` of Newton's mesh
    lie along a side; 0 ``steps`` of a frame stand for as many as the mesh needs.
    """

    flow: tuple[float, float, float] = (4.4, 2.6, 0.0)
    youngs_modulus: float = 3e4
    poisson_ratio: float = 0.3
    density: float = 60.0
    side: float = 0.06
    height: float = 0.30
    held: float = 0.03
    drag: float = 1.0
    air_density: float = 1.225
    gravity: float = 9.81
    damping: float = 0.5
    cells: int = 10
    steps: int = 0
    frames: int = 49
    fps: int = 24

    def __post_init__(self) -> None:
        """Check the mesh."""
        if self.cells < 2 or any(abs(part / self.block.cell - round(part / self.block.cell)) > 1e-6 for part in
                                 (self.height, self.held)):  # fmt: skip
            raise ValueError(
                f"Expected `cells` to cut {self.height} m and {self.held} m into cubes, two at least along "
                f"{self.side} m, but got {self.cells}: choose an even number."
            )

    @property
    def block(self) -> Block:
        """The body."""
        return Block(
            self.side, self.height, self.held, self.cells, self.youngs_modulus, self.poisson_ratio, self.density
        )

    @property
    def least_steps(self) -> int:
        """Steps of a frame, as many as the mesh needs where none are given."""
        e, nu = self.youngs_modulus, self.poisson_ratio
        wave = math.sqrt(e * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / self.density)
        return self.steps or math.ceil(wave / (STEP * self.block.cell * self.fps))

    def motion_settings(self) -> dict[str, Any]:
        """Everything that the motion depends on."""
        return asdict(self) | {"steps": self.least_steps, "solver": "newton, SolverSemiImplicit"}


def solve_soft(pattern: SoftPattern, path: Path) -> bool:
    """Solve the motion and write it as ``positions`` (F, V, 3) [m] of Newton's vertices, unless the file exists.

    Returns:
        Whether it was solved.
    """
    settings = pattern.motion_settings()
    if path.exists():
        check_settings(path, read_soft(path)[1], settings)
        return False
    air = Air(pattern.flow, pattern.air_density, pattern.drag)
    steps, fps = pattern.least_steps, pattern.fps
    positions = solve_block(pattern.block, air, pattern.frames, fps, steps, pattern.gravity, pattern.damping)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        np.savez_compressed(temporary, positions=positions, settings=json.dumps(settings))
    return True


def read_soft(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """The positions (F, V, 3) [m] and the settings of a motion."""
    found = read_arrays(path, "the motion of a soft body", ("positions", "settings"))
    return found["positions"], json.loads(str(found["settings"]))


def moved_places(pattern: SoftPattern, positions: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Where places of the body at rest are at each frame, between the vertices by trilinear interpolation.

    Units: ``positions``, ``places`` [m].

    Returns:
        Shape (F, P, 3), float64.
    """
    counts = np.array(pattern.block.counts)
    at = (places + np.array([0.5 * pattern.side, 0.5 * pattern.side, 0.0])) / pattern.block.cell
    low = np.clip(np.floor(at).astype(int), 0, counts - 1)
    share = np.clip(at - low, 0.0, 1.0)
    total = np.zeros((len(positions), len(places), 3))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (low + corner).T
        weight = np.where(corner, share, 1 - share).prod(1)
        total += weight[:, None] * positions[:, (k * (counts[1] + 1) + j) * (counts[0] + 1) + i]
    return total


# ---- the skin


def unfolded(pattern: SoftPattern, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Places on the print [m] of places on the skin (P, 3) with outward normals (P, 3); shape (P, 2).

    The six faces lie side by side as strips, in the order -x, x, -y, y, -z, z.
    """
    half = 0.5 * pattern.side
    axis = np.abs(normals).argmax(1)
    strip = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    across = np.where(axis == 0, places[:, 1], places[:, 0]) + half
    up = np.where(axis == 2, places[:, 1] + half, places[:, 2])
    return np.stack([strip * pattern.side + across, up], 1)


def colours(on_print: np.ndarray) -> np.ndarray:
    """Colours in 0 to 1 of places on the print [m], shape (..., 2) to (..., 3)."""
    u, v = (torch.from_numpy(np.ascontiguousarray(on_print[..., k])) for k in (0, 1))
    return printed_colours(PRINT * u, PRINT * v).numpy()


def texture(pattern: SoftPattern, pixel: float = 5e-4) -> np.ndarray:
    """The print in 0 to 1, upper row first, shape (H, W, 3), float32."""
    width, height = 6 * pattern.side, pattern.height
    u = (np.arange(round(width / pixel)) + 0.5) * pixel
    v = height - (np.arange(round(height / pixel)) + 0.5) * pixel
    return colours(np.stack(np.meshgrid(u, v), -1)).astype(np.float32)


def skin(pattern: SoftPattern) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The skin as squares: for each of its points a vertex of Newton's mesh, the squares, and places on the texture.

    Points on an edge exist once for each face, so that edges are sharp.

    Returns:
        Shapes (R,), (Q, 4) and (R, 2).
    """
    counts, rest = pattern.block.counts, pattern.block.vertices()
    number = np.arange(len(rest)).reshape(counts[2] + 1, counts[1] + 1, counts[0] + 1).transpose(2, 1, 0)
    points: list[np.ndarray] = []
    squares: list[np.ndarray] = []
    places: list[np.ndarray] = []
    begin = 0
    for axis in range(3):
        for end in (0, 1):
            sheet = np.take(number, -end, axis)
            if (axis == 1) != bool(end):  # the order of corners that makes the normal point outwards
                sheet = sheet.T
            index = begin + np.arange(sheet.size).reshape(sheet.shape)
            corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
            squares.append(np.stack(corners, -1).reshape(-1, 4))
            normal = np.zeros((sheet.size, 3))
            normal[:, axis] = 2 * end - 1
            points.append(sheet.reshape(-1))
            places.append(unfolded(pattern, rest[sheet.reshape(-1)], normal))
            begin += sheet.size
    size = [6 * pattern.side, pattern.height]
    return np.concatenate(points), np.concatenate(squares), np.concatenate(places) / size


def splat(pattern: SoftPattern, spacing: float = 0.004) -> GaussianCloud:
    """The post at rest as flat Gaussians on its skin, a hollow splat as of a capture."""
    half = 0.5 * pattern.side
    patches = box([-half, -half, 0.0], [half, half, pattern.height], spacing)
    on_print = unfolded(pattern, patches.center.numpy(), patches.normal.numpy())
    painted = patches.painted(torch.from_numpy(colours(on_print)))
    return to_cloud(painted, overlap=0.4, ambient=1.0)  # without baked light


# ---- files


def truth_fields(pattern: SoftPattern, video: FitVideo) -> dict[str, Any]:
    """What ``truth.json`` says: the wind, the material, and what else a simulation needs to be comparable."""
    return shared_truth(pattern, video) | {
        "nu": pattern.poisson_ratio,
        "law": "projected",
        "held": f"the lowest {pattern.held} m",
        "solver": "Newton's soft body; see docs/fit_data.md for what matches",
    }


def scene_settings(pattern: SoftPattern, video: FitVideo, folder: str) -> dict[str, Any]:
    """A configuration of ``gaussian-swaying sim`` for the case in a folder, with wrong values for what is sought."""
    foot = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [None, None, pattern.held]}}
    return shared_scene(pattern, video, "projected", folder) | {
        "scene": {
            "ply": f"{folder}/rest.ply",
            "metres_per_unit": 1.0,
            "area": "coverage",
            "filling": {"spacing": 0.005},
            "max_stretch": None,
        },
        "material": {"E": 1.5e4, "nu": pattern.poisson_ratio, "density": pattern.density, "law": "NeoHookean"},
        "solver": {
            "formulation": "total",
            "dx": 0.02,
            "cfl": 0.4,
            "gravity": [0.0, 0.0, -pattern.gravity],
            "damping": pattern.damping,
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": "nodes", "region": foot}}],
        },
    }
