"""The three flags of the paper's benchmark for an independent cloth solver, and their files.

Parameters are those of the paper's table; values that it does not give are chosen here and marked. Nothing in this file
needs Blender: ``blender_cloth.py`` solves, ``blender_images.py`` renders, ``make_flag_dataset.py`` combines them.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from blender_cloth import (
    BENDING_LIMIT,
    ClothMaterial,
    ClothRun,
    Grid,
    bending_number,
    blender_settings,
    solve_cloth,
)
from blender_images import View, look_at

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
PINNED = ("left", "corners", "top")


@dataclass(frozen=True)
class FlagPattern:
    """One flag of the benchmark: its material, how it is held, and what moves it.

    Seen from the -y side, the flag spans ``width`` to the right (x) and ``height`` upwards (z) from the origin. Then
    ``yaw`` turns it about z. Its initial normal, towards the reference camera, is -y turned by ``yaw``.

    Attributes:
        youngs_modulus: E [Pa]; paper.
        poisson_ratio: nu; paper. Blender's springs have 0.32 to 0.33.
        density: [kg/m³]; paper.
        flow: Velocity of the air [m/s], constant and uniform; paper.
        pinned: ``left`` edge, ``top`` edge, or three ``corners`` with the lower left one free; paper.
        texture: ``white``, ``stripes``, or the path of an image. White for pattern 1: paper.
        paper_drag: C_D, C_F and C_L of the paper's table, for the paper's force law. Kept for the record: Blender's
            wind follows another law.
        thickness: [m]; not given in the paper.
        width: [m]; not given in the paper, like ``height``.
        height: [m].
        yaw: Angle about z [degrees].
        ripple: Amplitude of one and a half waves along x in the rest shape [m]. Without it, a flat flag under gravity
            alone would buckle only by rounding errors.
        corner: Side of the square in which all vertices are held at a pinned corner [m].
        gravity: Along -z [m/s²]; paper.
        air_density: [kg/m³]; not given in the paper.
        damping: Rate at which every velocity decays [1/s].
        drag: C of the pressure ½ ρ C U² of the wind on a face at rest across the flow; default: a square plate.
        cells: Cells along the longer side, each with a vertex.
        quality: Steps of Blender's solver per frame; a power of two.
        frames: Number of frames, the first being the rest shape; paper.
        fps: Frames per second; paper.
        self_collision: Whether self-contact is on.
        bending: Bending stiffness as a share of that of a plate of this thickness.
    """

    youngs_modulus: float
    poisson_ratio: float
    density: float
    flow: tuple[float, float, float]
    pinned: str
    texture: str = "stripes"
    paper_drag: tuple[float, float, float] | None = (0.1, 0.3, 0.005)
    thickness: float = 0.01
    width: float = 1.2
    height: float = 0.8
    yaw: float = 0.0
    ripple: float = 0.0
    corner: float = 0.04
    gravity: float = 9.8
    air_density: float = 1.225
    drag: float = 1.28
    damping: float = 1.0
    cells: int = 120
    quality: int = 64
    frames: int = 250
    fps: int = 25
    self_collision: bool = False
    bending: float = 1.0

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ValueError: If one is out of range; the message names it.
        """
        for name in ("youngs_modulus", "density", "thickness", "width", "height", "corner"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Expected `{name}` to be positive and finite, but got {getattr(self, name)}.")
        for name in ("ripple", "gravity", "air_density", "drag", "damping", "bending"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"Expected `{name}` not to be negative, but got {getattr(self, name)}.")
        for name, least in (("cells", 2), ("quality", 1), ("frames", 2), ("fps", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"Expected `{name}` to be at least {least}, but got {getattr(self, name)}.")
        if self.quality & (self.quality - 1):
            raise ValueError(
                "Expected `quality` to be a power of two, since Blender adds up its steps in float32, but got "
                f"{self.quality}."
            )
        if self.pinned not in PINNED:
            raise ValueError(f"Expected `pinned` to be one of {', '.join(PINNED)}, but got {self.pinned!r}.")
        if len(self.flow) != 3:
            raise ValueError(f"Expected `flow` to have 3 numbers, but got {self.flow}.")

    # ---- shape

    @property
    def longer_side(self) -> float:
        """The longer side [m]."""
        return max(self.width, self.height)

    def turn(self) -> np.ndarray:
        """Rotation from the flag's own axes to those of the world, shape (3, 3)."""
        c, s = math.cos(math.radians(self.yaw)), math.sin(math.radians(self.yaw))
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def normal(self) -> np.ndarray:
        """Initial unit normal, towards the reference camera, shape (3,)."""
        return self.turn() @ np.array([0.0, -1.0, 0.0])

    def center(self) -> np.ndarray:
        """Middle of the flag at rest [m], shape (3,)."""
        return self.turn() @ np.array([0.5 * self.width, 0.0, 0.5 * self.height])

    def grid(self) -> Grid:
        """The mesh."""
        held = self.pinned if self.pinned in ("left", "top") else None
        return Grid.of_cells(self.width, self.height, self.cells, held)

    def rest(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [m] and unit normals of the rest shape at positions (..., 2) on the cloth, each (..., 3)."""
        u, v = uv[..., 0], uv[..., 1]
        wave = 3 * math.pi
        slope = self.ripple * wave / self.width * np.cos(wave * u)
        points = np.stack([u * self.width, self.ripple * np.sin(wave * u), v * self.height], -1)
        normals = np.stack([slope, -np.ones_like(u), np.zeros_like(u)], -1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return points @ self.turn().T, normals @ self.turn().T

    def pin_uv(self) -> np.ndarray:
        """The held parts, as boxes (u low, u high, v low, v high) on the cloth, shape (K, 4)."""
        if self.pinned == "left":
            return np.array([[0.0, 0.0, 0.0, 1.0]])
        if self.pinned == "top":
            return np.array([[0.0, 1.0, 1.0, 1.0]])
        u, v = self.corner / self.width, self.corner / self.height
        return np.array([[0.0, u, 1 - v, 1.0], [1 - u, 1.0, 1 - v, 1.0], [1 - u, 1.0, 0.0, v]])

    def pins(self, uv: np.ndarray) -> np.ndarray:
        """Indices of the positions (V, 2) that are held."""
        eps = 1e-9
        inside = [
            (uv[:, 0] >= a - eps) & (uv[:, 0] <= b + eps) & (uv[:, 1] >= c - eps) & (uv[:, 1] <= d + eps)
            for a, b, c, d in self.pin_uv()
        ]
        return np.flatnonzero(np.any(inside, axis=0))

    def truth(self) -> dict[str, np.ndarray]:
        """The rest shape: ``vertices``, ``normals`` (on the camera's side), triangles ``faces`` and ``uv``."""
        grid = self.grid()
        vertices, normals = self.rest(grid.uv())
        squares = grid.faces()
        triangles = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
        return {"vertices": vertices, "normals": normals, "faces": triangles, "uv": grid.uv()}

    # ---- physics

    def material(self) -> ClothMaterial:
        """The sheet that corresponds to a plate of this thickness."""
        plate = self.youngs_modulus * self.thickness**3 / (12 * (1 - self.poisson_ratio**2))
        return ClothMaterial(
            self.density * self.thickness,
            self.youngs_modulus * self.thickness,
            self.bending * plate,
            air_rate=self.damping,
        )

    def pressure(self) -> float:
        """½ ρ C U² [Pa]."""
        return 0.5 * self.air_density * self.drag * sum(u * u for u in self.flow)

    def run(self) -> ClothRun:
        """Gravity, wind and solver settings."""
        x, y, z = (float(u) for u in self.flow)
        return ClothRun(
            self.frames, self.fps, self.quality, self.gravity, (x, y, z), self.pressure(), self.self_collision
        )

    def cloth_settings(self) -> dict[str, Any]:
        """Everything that the motion depends on."""
        own = {name: value for name, value in asdict(self).items() if name not in ("texture", "paper_drag")}
        blender = blender_settings(self.grid(), self.material(), self.run())
        return own | {f"blender.{name}": value for name, value in blender.items()}


def least_quality(pattern: FlagPattern, least: int = 8) -> int:
    """The smallest power of two of steps per frame, from ``least``, that Blender's bending allows on this mesh."""
    number = bending_number(pattern.grid(), pattern.material(), replace(pattern, quality=1).run())
    quality = least
    while number / quality**2 > BENDING_LIMIT:
        quality *= 2
    return quality


PATTERNS = {
    1: FlagPattern(
        5e3, 0.3, 50.0, (0.0, 0.0, 0.0), "left", texture="white", paper_drag=None, ripple=0.003, damping=2.0
    ),
    2: FlagPattern(3e3, 0.3, 30.0, (2.5, 0.5, 0.0), "corners", drag=0.8),
    3: FlagPattern(3e3, 0.3, 20.0, (2.0, 0.0, 0.0), "top", width=2.0, height=1.2, yaw=-35.0, cells=140, quality=64),
}
"""The paper's three patterns. The wind of pattern 3 would blow along the flag's plane, so this flag is turned by 35
degrees. In patterns 2 and 3, the air then comes from the camera's side. Drag and damping are chosen so that the motion
converges with the mesh, see docs/flag_dataset.md."""


# ---- pictures

_BANDS = ((0.83, 0.30, 0.18), (0.95, 0.92, 0.85), (0.13, 0.33, 0.55))
_DISC, _WHITE = (0.93, 0.68, 0.20), 0.9


def draw_texture(pattern: FlagPattern, width: int = 1024) -> np.ndarray:
    """Colours of a flag in 0 to 1, upper row first, shape (H, W, 3), float32.

    ``white`` is plain, ``stripes`` has three bands and a disc, anything else is the path of an image.

    Raises:
        ValueError: If the image cannot be read.
    """
    if pattern.texture == "white":
        return np.full((2, 2, 3), _WHITE, dtype=np.float32)
    if pattern.texture != "stripes":
        import imageio.v3 as iio

        try:
            image = iio.imread(pattern.texture)
        except Exception as error:  # each image reader raises its own kinds of errors
            raise ValueError(
                f"Cannot read the texture {pattern.texture} ({error}): give white, stripes or an image."
            ) from error
        if image.dtype != np.uint8 or image.ndim != 3:
            raise ValueError(f"The texture {pattern.texture} is not an image of 8 bits in colour: export it as such.")
        return (image[..., :3] / 255).astype(np.float32)
    height = max(2, round(width * pattern.height / pattern.width))
    x = (np.arange(width) + 0.5) / width * pattern.width
    z = (1 - (np.arange(height) + 0.5) / height)[:, None] * pattern.height
    band = ((1 - z / pattern.height) * 3).astype(np.int64).clip(0, 2)
    colors = np.array(_BANDS)[np.broadcast_to(band, (height, width))]
    disc = np.hypot(x - 0.5 * pattern.width, z - 0.5 * pattern.height) < 0.2 * pattern.height
    colors[disc] = _DISC
    return colors.astype(np.float32)


def sphere_views(pattern: FlagPattern, count: int, size: int, angle: float = math.radians(40.0)) -> list[View]:
    """Cameras all around the flag at rest, spread evenly over a sphere on a golden spiral, upright in z.

    Args:
        pattern: The flag; each image shows all of it.
        count: Number of cameras.
        size: Width and height of their images [pixels].
        angle: Field of view [radians].
    """
    radius = 1.1 * 0.5 * math.hypot(pattern.width, pattern.height, 2 * pattern.ripple) / math.sin(0.5 * angle)
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = math.pi * (1 + math.sqrt(5)) * index
    flat = np.sqrt(1 - z * z)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)
    center = pattern.center()
    return [View(look_at(center + radius * ray, center), angle, size, size) for ray in rays]


def reference_view(
    pattern: FlagPattern, positions: np.ndarray, width: int, height: int, angle: float = math.radians(40.0)
) -> View:
    """The camera of the reference video: it looks along the initial normal, and the whole motion is in view.

    Args:
        pattern: The flag.
        positions: The motion [m], shape (F, V, 3).
        width: Width of the image [pixels].
        height: Height of the image [pixels].
        angle: Horizontal field of view [radians].
    """
    normal = pattern.normal()
    frame = look_at(pattern.center() + normal, pattern.center())[:3, :3]
    seen = positions.reshape(-1, 3).astype(np.float64) @ frame  # right, up, towards the camera
    middle = 0.5 * (seen.min(0) + seen.max(0))
    tangent = math.tan(0.5 * angle) * np.array([1.0, height / width]) / 1.08  # 4 % of margin on each side
    middle[2] = max((np.abs(seen[:, k] - middle[k]) / tangent[k] + seen[:, 2]).max() for k in (0, 1))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame, frame @ middle
    return View(pose, angle, width, height)


def lamp_position(pattern: FlagPattern, side: int = 1) -> np.ndarray:
    """Position of the area light [m]: on the initial normal, six flag lengths away; ``side`` -1 mirrors it."""
    return pattern.center() + side * 6.0 * pattern.longer_side * pattern.normal()


def frame_order(count: int, stride: int = 10) -> list[int]:
    """The order in which frames are made: every ``stride``-th first, so that an unfinished set spans the motion."""
    return sorted(range(count), key=lambda frame: (frame % stride != 0, frame))


def transforms_fields(views: list[View], names: list[str]) -> dict[str, Any]:
    """The fields of a ``transforms.json`` for cameras that differ only in pose."""
    view = views[0]
    frames = [{"file_path": name, "transform_matrix": v.pose.tolist()} for v, name in zip(views, names, strict=True)]
    return {
        "camera_angle_x": view.angle_x,
        "fl_x": view.focal,
        "fl_y": view.focal,
        "cx": 0.5 * view.width,
        "cy": 0.5 * view.height,
        "w": view.width,
        "h": view.height,
        "frames": frames,
    }


# ---- settings and files


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


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let ``write`` fill a temporary file and then rename it to ``path``, so that no half-written file is left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    write(partial)
    os.replace(partial, path)


def write_json(path: Path, data: Any) -> None:
    """Write JSON, completely or not at all."""
    write_whole(path, lambda partial: partial.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8"))


@dataclass(frozen=True, eq=False)
class Cloth:
    """The motion of a flag.

    Attributes:
        positions: Vertices at each frame [m], float32, shape (F, V, 3).
        faces: Squares as indices of vertices, with normals on the camera's side; shape (Q, 4).
        uv: Position of each vertex on the flag, in 0 to 1, (V, 2). Vertex i (rows + 1) + j is the j-th of column i.
        columns: Faces along u.
        rows: Faces along v.
        settings: Fields of the :class:`FlagPattern` that determine the motion.
    """

    positions: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    columns: int
    rows: int
    settings: dict[str, Any]

    def sample(self, uv: np.ndarray) -> np.ndarray:
        """Points on the surface at each frame [m], for positions (P, 2) on the flag; bilinear; shape (F, P, 3)."""
        i, s = _between(self.uv[:: self.rows + 1, 0], uv[:, 0])
        j, t = _between(self.uv[: self.rows + 1, 1], uv[:, 1])
        at = self.positions.reshape(len(self.positions), self.columns + 1, self.rows + 1, 3)
        low = (1 - t) * at[:, i, j] + t * at[:, i, j + 1]
        high = (1 - t) * at[:, i + 1, j] + t * at[:, i + 1, j + 1]
        return (1 - s) * low + s * high


def _between(nodes: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The interval of ascending ``nodes`` that contains each place (P,), and the share of it, float32, (P, 1)."""
    low = np.searchsorted(nodes[1:-1], places, side="right")
    return low, ((places - nodes[low]) / np.diff(nodes)[low]).astype(np.float32)[:, None]


def solve_pattern(pattern: FlagPattern, path: Path, report: Callable[[int], None] | None = None) -> bool:
    """Solve a flag and write its motion, unless the file exists.

    Args:
        pattern: The flag.
        path: The ``.npz`` to write, see :func:`read_cloth`.
        report: Called after each frame.

    Returns:
        Whether it was solved.

    Raises:
        ImportError: If ``bpy`` is not there.
        ValueError: If the file exists but has other settings, or if ``quality`` is too low for the mesh.
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

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_whole(path, write)
    return True


def read_cloth(path: str | os.PathLike[str]) -> Cloth:
    """Read a motion.

    Args:
        path: The ``.npz``. Besides the fields of :class:`Cloth` it has ``rest_normals``, ``pins`` (indices),
            ``pin_uv`` (boxes), ``areal_density``, ``membrane_stiffness``, ``bending_stiffness``, ``gravity``, ``flow``
            and more, with their ``units``, and the ``hash`` of ``settings``.

    Raises:
        ValueError: If it is not such a file.
    """
    try:
        with np.load(path) as data:
            settings = json.loads(str(data["settings"]))
            positions, faces, uv = (data[name] for name in ("positions", "faces", "uv"))
            return Cloth(positions, faces, uv, int(data["columns"]), int(data["rows"]), settings)
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is not the motion of a flag ({error}): make it again.") from error


# ---- uncertainty of the reference


def even_uv(pattern: FlagPattern, along: int = 80) -> np.ndarray:
    """Positions spread evenly over the flag at rest, ``along`` of them on the longer side, shape (P, 2)."""
    spacing = pattern.longer_side / along
    counts = [max(1, round(side / spacing)) for side in (pattern.width, pattern.height)]
    axes = [(np.arange(count) + 0.5) / count for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


def chamfer_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Half the sum of the mean distances from each set of points to the nearest of the other.

    Args:
        a: Points, shape (P, 3).
        b: Points, shape (Q, 3).

    Returns:
        Not squared, in the unit of the points.
    """
    import torch

    from gaussian_swaying.metrics.chamfer import chamfer_distance as between

    one, other = (torch.from_numpy(np.ascontiguousarray(points)) for points in (a, b))
    return float(between(one, other, direction="average"))


def difference(pattern: FlagPattern, a: Cloth, b: Cloth, every: int = 1, along: int = 80) -> dict[str, Any]:
    """Distance between two solutions of one flag.

    Args:
        pattern: The flag.
        a: One solution.
        b: The other solution, on any mesh.
        every: Compare only every ``every``-th frame.
        along: Points along the longer side, see :func:`even_uv`.

    Returns:
        As shares of the longer side: ``chamfer``, the mean of :func:`chamfer_distance` over the frames;
        ``chamfer_per_frame``; and ``corresponding``, the mean distance between the same positions on the cloth.

    Raises:
        ValueError: If the numbers of frames differ.
    """
    if len(a.positions) != len(b.positions):
        raise ValueError(f"Expected as many frames in both solutions, but got {len(a.positions)}, {len(b.positions)}.")
    uv = even_uv(pattern, along)
    one, other = (cloth.sample(uv)[::every] for cloth in (a, b))
    distances = [chamfer_distance(p, q) / pattern.longer_side for p, q in zip(one, other, strict=True)]
    apart = np.linalg.norm(one - other, axis=-1).mean() / pattern.longer_side
    return {
        "chamfer": float(np.mean(distances)),
        "corresponding": float(apart),
        "chamfer_per_frame": [round(value, 6) for value in distances],
        "frames_compared": len(distances),
        "points": len(uv),
    }


VARIANTS = ("steps doubled", "coarser", "finer", "half the cells", "hardly bending", "self-contact")


def variants(pattern: FlagPattern, names: Iterable[str] = VARIANTS) -> dict[str, FlagPattern]:
    """The same flag with twice the steps, and on meshes with three and five quarters as many cells along a side.

    The last two are different flags, on half as many cells: one with a fiftieth of the bending stiffness, which shows
    the effect of bending, and one with self-contact. The same flag on that mesh is included for comparison. Where the
    mesh changes, the steps change by powers of two, so that Blender's bending stays within its limit.
    """
    coarser, finer = (replace(pattern, cells=times * pattern.cells // 4) for times in (3, 5))
    half = replace(pattern, cells=pattern.cells // 2)
    slack, apart = replace(half, bending=0.02), replace(half, self_collision=True)
    table = {
        "steps doubled": replace(pattern, quality=2 * pattern.quality),
        "coarser": replace(coarser, quality=least_quality(coarser)),
        "finer": replace(finer, quality=least_quality(finer)),
        "half the cells": replace(half, quality=least_quality(half)),
        "hardly bending": replace(slack, quality=least_quality(slack)),
        "self-contact": replace(apart, quality=least_quality(apart)),
    }
    return {name: table[name] for name in names}
