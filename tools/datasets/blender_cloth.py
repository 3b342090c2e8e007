"""Blender's cloth solver in SI units, for ``make_flag_dataset.py``.

``bpy`` is imported when a cloth is solved. The relations between Blender's settings and SI units were measured on
panels (commit a5a45c7), because Blender documents none of them. Blender's cloth counts time in frames: a stiffness in
its units is one in N/m divided by fps².
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LATTICE = 4 / 3
"""E h divided by the stiffness of a spring, in a square lattice with one diagonal per square, alternating from square
to square, and all springs alike. This is the value of isotropic lattices, and also the measured one."""

BENDING = 0.0295
"""Bending stiffness D [N m] divided by ``bending_stiffness`` x edge² x fps², measured on a cantilever. The cantilever
is modelled as a chain of stiff squares on hinges, the first at the clamp, because a square that bends across its sides
does not bend along its diagonal."""

BENDING_LIMIT = 1.25
"""Blender's bending is explicit: ``bending_number`` must stay below this. Compared with much shorter steps, the
motion of pattern 2 on cells of 2 cm is off by 2 to 4 mm at 1.2 and by 1 mm at 0.3. At 4.9 it is wrong, although nothing
blows up."""

SPRING_TIME = 2.2e-3
"""Damping of a membrane spring divided by its stiffness [s]: that of Blender's defaults on flags of 2 cm cells."""

SELF_DISTANCE = 16 / 9
"""Distance that Blender's cloth keeps from itself, divided by ``self_distance_min``; also measured."""

SELF_REACH = 0.7
"""Blender looks for contact up to twice ``self_distance_min``, also between triangles of a flat sheet that share no
vertex. The closest of them are 0.71 cells apart: beyond that the sheet pushes itself apart in its own plane."""

COLLISION_QUALITY = 4
"""Rounds of Blender's contact in a step."""

BENDING_DAMPING = 0.5 / 0.3
"""``bending_damping`` divided by vertex mass: Blender's defaults, for the mass that they assume. It is explicit too.
Divided by vertex mass and quality, 0.4 crumpled a flag of 1 cm cells at the scale of its mesh; 0.1 and less did not."""


def require_bpy() -> Any:
    """Import ``bpy``."""
    try:
        import bpy
    except ImportError as error:
        raise ImportError(
            "The flag data set needs Blender as a Python module: install it with "
            "`pip install 'gaussian-swaying[blender]'`, under Python 3.11."
        ) from error
    return bpy


def edges(triangles: np.ndarray) -> np.ndarray:
    """Each edge of triangles (T, 3) once, int64, shape (E, 2)."""
    first, second = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1).T
    count = int(triangles.max()) + 1
    return np.stack(np.divmod(np.unique(first.astype(np.int64) * count + second), count), axis=-1)


@dataclass(frozen=True)
class Grid:
    """A rectangular cloth as a mesh in the x-z plane, in which every vertex represents the same share of the cloth.

    Blender gives every vertex the same mass and every line of springs the same stiffness, at the rim or not. Therefore
    the cloth is cut into equal cells with a vertex in the middle of each, and the vertices of the outermost cells are
    moved out to the rim. The result is a mesh of squares with an outer ring one and a half cells wide. With a ring of
    one cell, a vertex at the rim would have the mass of a cell but half its area, an error of first order in the cell.
    Along a held edge the mass of the rim does not matter, and a ring of one cell is right.

    Vertex ``i * (rows + 1) + j`` is the j-th from below in the i-th column.

    Attributes:
        width: Length along x [m].
        height: Length along z [m].
        columns: Number of faces along x.
        rows: Number of faces along z.
        held: The held edges: ``left``, ``top``, ``sides`` (left and right) or None.
    """

    width: float
    height: float
    columns: int
    rows: int
    held: str | None = None

    @classmethod
    def of_cells(cls, width: float, height: float, cells: int, held: str | None = None) -> Grid:
        """The mesh with ``cells`` square cells along the longer side."""
        cell = max(width, height) / cells
        across, up = max(1, round(width / cell)), max(1, round(height / cell))
        if abs(height / up / (width / across) - 1) > 0.05 or min(across, up) < 2:
            raise ValueError(
                f"Expected `cells` to cut {width} m x {height} m into squares, two at least each way, but {cells} "
                f"gives {across} x {up} of {width / across:.4f} m x {height / up:.4f} m: choose a number of cells that "
                "divides both sides."
            )
        return cls(width, height, across - 1, up - 1, held)

    @property
    def cells(self) -> tuple[float, float]:
        """Sides of a cell along x and z [m]; half a cell of the cloth belongs to a held edge."""
        across = {"left": 0.5, "sides": 0.0}.get(self.held or "", 1.0)
        return self.width / (self.columns + across), self.height / (self.rows + (0.5 if self.held == "top" else 1.0))

    @property
    def cell(self) -> float:
        """Side of a square with the area of a cell [m]."""
        return math.sqrt(math.prod(self.cells))

    @property
    def spring(self) -> float:
        """Mean length of the springs [m], by which Blender divides every stiffness."""
        flat, ends = self.flat(), edges(self.triangles())
        return float(np.linalg.norm(flat[ends[:, 0]] - flat[ends[:, 1]], axis=1).mean())

    @property
    def count(self) -> int:
        """Number of vertices."""
        return (self.columns + 1) * (self.rows + 1)

    def uv(self) -> np.ndarray:
        """Place of each vertex on the cloth, in 0 to 1, float64, shape (V, 2)."""
        first = 1.0 if self.held in ("left", "sides") else 1.5
        u = np.r_[0.0, (first + np.arange(self.columns - 1)) * self.cells[0] / self.width, 1.0]
        v = np.r_[0.0, (1.5 + np.arange(self.rows - 1)) * self.cells[1] / self.height, 1.0]
        return np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)

    def triangles(self) -> np.ndarray:
        """The faces cut into two, along alternating diagonals, as they are given to Blender; (2 Q, 3).

        For squares, Blender adds both diagonals, but those springs do not push back. Such a square is half as stiff in
        shear, and its diagonals do not resist bending. A diagonal that is an edge of the mesh is a spring like any
        other.
        """
        faces = self.faces()
        column, row = np.divmod(np.arange(len(faces)), self.rows)
        even = ((column + row) % 2 == 0)[:, None]
        first = np.where(even, faces[:, [0, 1, 2]], faces[:, [0, 1, 3]])
        second = np.where(even, faces[:, [0, 2, 3]], faces[:, [1, 2, 3]])
        return np.concatenate([first, second])

    def faces(self) -> np.ndarray:
        """Faces as indices of vertices, with normals on the -y side; int64, shape (Q, 4)."""
        corner = (np.arange(self.columns)[:, None] * (self.rows + 1) + np.arange(self.rows)).reshape(-1)
        return np.stack([corner, corner + self.rows + 1, corner + self.rows + 2, corner + 1], -1)

    def flat(self) -> np.ndarray:
        """Vertices [m] of the flat cloth, float64, shape (V, 3)."""
        u, v = self.uv().T
        return np.stack([u * self.width, np.zeros_like(u), v * self.height], -1)


@dataclass(frozen=True)
class ClothMaterial:
    """A sheet in SI units.

    Attributes:
        areal_density: Mass per area [kg/m²].
        membrane: Young's modulus times thickness, E h [N/m].
        bending: Bending stiffness D [N m].
        spring_time: Damping of a membrane spring divided by its stiffness [s].
        air_rate: Rate at which every velocity decays [1/s].
    """

    areal_density: float
    membrane: float
    bending: float
    spring_time: float = SPRING_TIME
    air_rate: float = 0.0


@dataclass(frozen=True)
class ClothRun:
    """Gravity, wind and solver settings of a run.

    Attributes:
        frames: Number of frames; the first is the rest shape.
        fps: Frames per second.
        quality: Solver steps per frame.
        gravity: Along -z [m/s²].
        flow: Velocity of the air [m/s].
        pressure: Pressure of the air on a face at rest across the flow [Pa].
        self_collision: Whether self-contact is on, without friction.
        self_distance: Distance that the cloth then keeps from itself [m]; None for half a cell.
    """

    frames: int
    fps: int = 25
    quality: int = 16
    gravity: float = 9.8
    flow: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pressure: float = 0.0
    self_collision: bool = False
    self_distance: float | None = None


def bending_number(grid: Grid, material: ClothMaterial, run: ClothRun) -> float:
    """The number that must stay below ``BENDING_LIMIT``: bending stiffness over vertex mass and quality squared."""
    settings = blender_settings(grid, material, run)
    return settings["bending_stiffness"] / (settings["mass"] * run.quality**2)


def blender_settings(grid: Grid, material: ClothMaterial, run: ClothRun) -> dict[str, float]:
    """Blender's settings for a sheet, from the measured relations.

    Returns:
        ``mass`` to ``air_damping`` of the cloth, ``gravity`` of the scene, ``strength`` and ``flow`` of the wind; with
        self-contact, ``self_distance_min`` to ``collision_quality`` of the collisions.
    """
    rate2 = run.fps**2
    mass = material.areal_density * grid.cell**2
    spring = material.membrane / LATTICE  # N/m
    tension = spring * grid.spring / rate2
    bending = material.bending / (BENDING * grid.cell**2 * rate2)
    damping = material.spring_time * spring / run.fps
    speed = math.hypot(*run.flow)
    field = run.pressure / (0.02 * run.fps)
    return _contact_settings(grid, run) | {
        "mass": mass,
        "tension_stiffness": tension,
        "compression_stiffness": tension,
        "bending_stiffness": bending,
        "tension_damping": damping,
        "compression_damping": damping,
        "bending_damping": BENDING_DAMPING * mass,
        "air_damping": material.air_rate * mass / (0.01 * run.fps),
        "gravity": -1000.0 * run.gravity / rate2,
        "strength": field,
        "flow": field / speed if speed else 0.0,
    }


def _contact_settings(grid: Grid, run: ClothRun) -> dict[str, float]:
    if not run.self_collision:
        return {}
    distance = 0.5 * grid.cell if run.self_distance is None else run.self_distance
    setting = distance / SELF_DISTANCE
    if 2 * setting > SELF_REACH * min(grid.cells):
        raise ValueError(
            f"Expected `self_distance` of at most {0.5 * SELF_DISTANCE * SELF_REACH * min(grid.cells):.4f} m on cells "
            f"of {min(grid.cells):.4f} m, but got {distance:g} m: beyond that a flat cloth pushes itself apart; lower "
            "it, or take fewer `cells`."
        )
    return {"self_distance_min": setting, "self_friction": 0.0, "collision_quality": COLLISION_QUALITY}


def solve_cloth(
    grid: Grid,
    vertices: np.ndarray,
    pins: Sequence[int] | np.ndarray,
    material: ClothMaterial,
    run: ClothRun,
    report: Any = None,
) -> np.ndarray:
    """Simulate a sheet with Blender.

    Units: ``vertices`` [m].

    Returns:
        Vertices at each frame [m], float32, shape (frames, V, 3).
    """
    number = bending_number(grid, material, run)
    if number > BENDING_LIMIT:
        needed = math.ceil(run.quality * math.sqrt(number / BENDING_LIMIT))
        raise ValueError(
            f"Expected `quality` of at least {needed} for cells of {grid.cell:.4f} m and this bending stiffness "
            f"(Blender's bending is explicit), but got {run.quality}."
        )
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = run.fps
    scene.frame_start, scene.frame_end = 1, run.frames
    settings = blender_settings(grid, material, run)
    scene.use_gravity = run.gravity != 0.0
    scene.gravity = (0.0, 0.0, settings["gravity"])

    mesh = bpy.data.meshes.new("sheet")
    mesh.from_pydata(np.asarray(vertices, dtype=np.float64).tolist(), [], grid.triangles().tolist())
    sheet = bpy.data.objects.new("sheet", mesh)
    scene.collection.objects.link(sheet)
    if settings["strength"]:
        _add_wind(bpy, scene, run, settings)
    bpy.context.view_layer.objects.active = sheet
    modifier = sheet.modifiers.new("cloth", "CLOTH")
    cloth = modifier.settings
    cloth.quality, cloth.time_scale = run.quality, 1.0
    cloth.bending_model = "ANGULAR"
    contact = _contact_settings(grid, run)
    for name in settings.keys() - {"gravity", "strength", "flow", *contact}:
        setattr(cloth, name, settings[name])
    for name in ("tension", "compression", "bending"):  # so that no vertex group scales a stiffness
        setattr(cloth, f"{name}_stiffness_max", settings[f"{name}_stiffness"])
    cloth.use_pressure = cloth.use_internal_springs = cloth.use_dynamic_mesh = False
    modifier.collision_settings.use_collision = False
    modifier.collision_settings.use_self_collision = run.self_collision
    for name, value in contact.items():
        setattr(modifier.collision_settings, name, value)
    pins = np.asarray(pins, dtype=np.int64)
    if len(pins):
        group = sheet.vertex_groups.new(name="pins")
        group.add(pins.tolist(), 1.0, "REPLACE")
        cloth.vertex_group_mass = "pins"
        cloth.pin_stiffness = 1.0
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 1, run.frames

    positions = np.empty((run.frames, grid.count, 3), dtype=np.float32)
    flat = np.empty(grid.count * 3, dtype=np.float32)
    for frame in range(1, run.frames + 1):
        scene.frame_set(frame)
        moved = sheet.evaluated_get(bpy.context.evaluated_depsgraph_get())
        moved.data.vertices.foreach_get("co", flat)
        positions[frame - 1] = flat.reshape(-1, 3)
        if not np.isfinite(flat).all():
            raise ArithmeticError(f"Blender's cloth blew up in frame {frame}: raise `quality`.")
        if report:
            report(frame)
    return positions


def _add_wind(bpy: Any, scene: Any, run: ClothRun, settings: dict[str, float]) -> None:
    from mathutils import Vector

    bpy.ops.object.effector_add(type="WIND")  # sets flow, wind factor and shape; forcefield_toggle leaves them at 0
    wind = bpy.context.object
    wind.rotation_mode = "QUATERNION"
    wind.rotation_quaternion = Vector((0.0, 0.0, 1.0)).rotation_difference(Vector(run.flow))
    field = wind.field
    field.shape, field.falloff_power, field.noise, field.wind_factor = "PLANE", 0.0, 0.0, 1.0
    field.apply_to_location, field.apply_to_rotation, field.use_absorption = True, True, False
    field.strength, field.flow = settings["strength"], settings["flow"]
    bpy.context.view_layer.update()
