"""The three flags of the paper's benchmark, and two more, as an independent cloth solver sees them.

Nothing in this file needs Blender: ``blender_cloth.py`` solves, ``blender_images.py`` renders,
``make_flag_dataset.py`` combines them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from blender_cloth import BENDING_LIMIT, ClothMaterial, ClothRun, Grid, bending_number, blender_settings

PINNED = ("left", "corners", "top", "sides")

PAPER = (1, 2, 3)
"""The numbers of the paper's flags in ``PATTERNS``."""


@dataclass(frozen=True)
class FlagPattern:
    """One flag of the benchmark: its material, how it is held, and what moves it.

    Seen from the -y side, the flag spans ``width`` to the right (x) and ``height`` upwards (z) from the origin. Then
    ``yaw`` turns it about z. Its initial normal, towards the reference camera, is -y turned by ``yaw``.

    Of patterns 1 to 3 the paper gives E, nu, density, flow, pins, gravity, frames, their rate and the white of pattern
    1, but not thickness, size and density of the air.

    Attributes:
        youngs_modulus: E [Pa].
        poisson_ratio: nu; Blender's springs have 0.32 to 0.33.
        density: [kg/m³].
        flow: Velocity of the air [m/s].
        pinned: ``left`` edge, ``top`` edge, both ``sides``, or three ``corners`` with the lower left one free.
        texture: ``white``, ``stripes``, or the path of an image.
        paper_drag: C_D, C_F and C_L of the paper's table; Blender's wind follows another law.
        thickness: [m].
        width: [m].
        height: [m].
        yaw: Angle about z [degrees].
        ripple: Amplitude of one and a half waves along x in the rest shape [m]. Without it, a flat flag under gravity
            alone would buckle only by rounding errors.
        corner: Side of the square in which all vertices are held at a pinned corner [m].
        gravity: Along -z [m/s²].
        air_density: [kg/m³].
        damping: Rate at which every velocity decays [1/s].
        drag: C of the pressure ½ ρ C U² of the wind on a face at rest across the flow; default: a square plate.
        cells: Cells along the longer side.
        quality: Steps of Blender's solver per frame; a power of two.
        frames: Number of frames, the first being the rest shape.
        fps: Frames per second.
        self_collision: Whether self-contact is on.
        self_distance: Distance that the cloth then keeps from itself [m]; null: half a cell.
        bending: Bending stiffness as a share of that of a plate.
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
    self_distance: float | None = None
    bending: float = 1.0

    def __post_init__(self) -> None:
        """Check the fields."""
        for name in ("youngs_modulus", "density", "thickness", "width", "height", "corner"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Expected `{name}` to be positive and finite, but got {getattr(self, name)}.")
        for name in ("ripple", "gravity", "air_density", "drag", "damping", "bending"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"Expected `{name}` not to be negative, but got {getattr(self, name)}.")
        for name, least in (("cells", 2), ("quality", 1), ("frames", 2), ("fps", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"Expected `{name}` to be at least {least}, but got {getattr(self, name)}.")
        if self.self_distance is not None and not 0 < self.self_distance < math.inf:
            raise ValueError(f"Expected `self_distance` to be positive and finite, but got {self.self_distance}.")
        if self.quality & (self.quality - 1):
            raise ValueError(
                "Expected `quality` to be a power of two, since Blender adds up its steps in float32, but got "
                f"{self.quality}."
            )
        if not 0 <= self.poisson_ratio < 0.5:
            raise ValueError(f"Expected `poisson_ratio` to be at least 0 and below 0.5, but got {self.poisson_ratio}.")
        if not math.isfinite(self.yaw):
            raise ValueError(f"Expected `yaw` to be finite, but got {self.yaw}.")
        if self.pinned not in PINNED:
            raise ValueError(f"Expected `pinned` to be one of {', '.join(PINNED)}, but got {self.pinned!r}.")
        if len(self.flow) != 3 or not all(map(math.isfinite, self.flow)):
            raise ValueError(f"Expected `flow` to have 3 finite numbers, but got {self.flow}.")

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
        held = None if self.pinned == "corners" else self.pinned
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
        if self.pinned == "sides":
            return np.array([[0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 0.0, 1.0]])
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
            self.frames,
            self.fps,
            self.quality,
            self.gravity,
            (x, y, z),
            self.pressure(),
            self.self_collision,
            self.self_distance,
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
    4: FlagPattern(
        3e3, 0.3, 20.0, (1.8, 0.0, 0.0), "top", width=1.0, height=1.4, yaw=-60.0, cells=112, paper_drag=None
    ),
    5: FlagPattern(8e3, 0.3, 15.0, (3.0, 0.0, 0.0), "top", yaw=-60.0, cells=100, quality=128, paper_drag=None),
}
"""The paper's three patterns, and two more.

The wind of pattern 3 would blow along the flag's plane, so this flag is turned by 35 degrees. In patterns 2 and 3, the
air then comes from the camera's side. Drag and damping are chosen so that the motion converges with the mesh, see
docs/flag_dataset.md.

Pattern 4 is a curtain of the cloth of pattern 3. Pattern 5 is light (0.15 kg/m²) and stiff (E h = 80 N/m). Both hang by
their top edge in a wind at 60 degrees to their plane and leave that edge at an angle, so they show how well a held edge
is modelled. All of their numbers are chosen here."""
