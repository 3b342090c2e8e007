r"""Cusick's test: a round fabric hangs over a smaller disc, and its shadow is measured.

Cusick (1965), "The dependence of fabric drape on bending and shear stiffness", Journal of the Textile Institute 56
(11). The drape coefficient is the share of the free ring that the shadow covers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.problems.fabrics import FABRICS, GRAVITY, THICK
from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.regions import Cylinder
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.patches import sheet, to_cloud
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.simulation import Simulation

DISC, FABRIC = 0.09, 0.15
"""Radii of the disc and of the fabric [m]."""
NU, HELD = 0.3, 2.0  # Poisson's ratio; cells of the fabric on the disc
STRETCH = 100.0
"""E h [N/m], so that the sheet shears as easily as a fabric."""
SHELL = {
    "interlock": (0.673366, 0.691930, 0.718115, 0.735056), "rib": (0.730248, 0.737550, 0.758769, 0.777412),
    "ponte": (0.668749, 0.678960, 0.702975, 0.721462), "denim": (0.764074, 0.767318, 0.785642, 0.803996),
}  # fmt: skip
"""Drape coefficients with 4, 5, 6 and 7 folds of a shell of Kirchhoff and Love with the same numbers and folds that are
alike, by splines on eight cells along the free width and around half a fold, computed apart from the package (commit
550c24a). On 20 cells that of ponte with five folds is 0.677346."""


@dataclass(eq=False)
class RingScene(ProceduralScene):
    """A level ring around the origin, in rings of patches.

    Units: ``inner``, ``outer``, ``spacing`` [m].
    """

    inner: float = DISC
    outer: float = FABRIC
    spacing: float = 0.002

    def __post_init__(self) -> None:
        self.check("inner", "outer")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rings, and of Gaussians along each."""
        wide = self.outer - self.inner
        return round(wide / self.spacing), math.ceil(2 * math.pi * self.outer / self.spacing)

    def generate(self) -> GaussianCloud:
        """Make the ring, from the inside to the outside."""

        def level(v: Tensor, u: Tensor) -> Tensor:
            r, turn = torch.lerp(torch.full_like(v, self.inner), torch.full_like(v, self.outer), v), 2 * math.pi * u
            return torch.stack([r * torch.cos(turn), r * torch.sin(turn), torch.zeros_like(r)], dim=-1)

        return to_cloud(sheet(level, *self.shape))


def bending_length(mass: float, stiffness: float) -> float:
    """Peirce's bending length [m], the cube root of the bending stiffness [N m] over the weight to a unit of area."""
    return (stiffness / (mass * GRAVITY)) ** (1 / 3)


def shadow(edge: np.ndarray) -> float:
    """Drape coefficient of a closed edge (N, 3) that goes once around: the shadow beyond the disc over the ring."""
    x, y = edge[:, 0], edge[:, 1]
    area = 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return (area - math.pi * DISC**2) / (math.pi * (FABRIC**2 - DISC**2))


def drape(
    fabric: str,
    folds: int,
    cells: int = 12,
    settle: float = 12.0,
    seed: float = 0.3,
    layers: int = 3,
    settings: Settings | None = None,
) -> Result:
    r"""Let a fabric drape over a disc under its weight, from a scene as a user makes it.

    The disc holds the fabric between its faces, as a clamp. The fabric is thrown with the folds it is to have, and
    damped until it rests.

    Returns:
        ``drape``, ``folds_found`` (which wave of the edge is the largest), ``low`` and ``high`` (of the edge [m]),
        ``length`` (Peirce's bending length [m]), ``weight`` (mass over the exact one), ``residual`` (largest speed
        along the edge over that of the falling strip), ``points`` and the common quantities; ``error`` is relative to
        the shell with as many folds.
    """
    settings = Settings(dtype=torch.float32) if settings is None else settings
    mass, stiffness = FABRICS[fabric]
    width = FABRIC - DISC
    dx = width / cells
    spacing = width / (2 * cells)
    scene = RingScene(DISC - math.ceil(HELD * dx / spacing) * spacing, FABRIC, spacing)
    rings, count = scene.shape
    omega = 3.516015 / width**2 * math.sqrt(stiffness / mass)
    pin = PinnedRegion(Cylinder([0.0] * 3, [0.0, 0.0, 1.0], DISC, 1.0), "clamp")
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY), boundaries=[pin], damping=2 * omega)
    material = Material(E=STRETCH / THICK, nu=NU, density=mass / THICK, thickness=THICK, bending=stiffness)
    made = Scene(generator=scene, metres_per_unit=1.0, layers=layers, points="gaussian")
    simulation = Simulation(made, material, solver=solver, device=settings.device)
    points, solver = simulation.scene.points, simulation.solver
    assert isinstance(solver, MPMSolver)
    place = simulation.scene.frame.point_to_scene(points.position.double())
    radius, turn = place[:, :2].norm(dim=1), torch.atan2(place[:, 1], place[:, 0])
    middle = place[:, 2].abs() < 1e-6
    wave = ((radius - DISC).clamp(min=0) / width).square() * torch.cos(folds * turn)
    velocity = torch.zeros_like(points.position)
    velocity[:, 2] = (seed * width * omega * wave).to(velocity)
    start = solver.init_state(points, velocity, frame=simulation.scene.frame)
    outer = middle.nonzero()[:, 0].reshape(rings, count)[-2:]

    def edge(state: object) -> Tensor:
        return 1.5 * state.position[outer[1]] - 0.5 * state.position[outer[0]]  # type: ignore[attr-defined]

    frames = 48
    run = follow(solver, start, settle / omega / frames, frames, edge)
    shift = simulation.scene.frame.point_to_scene(points.position[outer[1]].double()) - points.position[outer[1]]
    series = run.series + shift.double().cpu().mean(0)
    last = series[-1].numpy()
    speed = float((series[-1] - series[-2]).norm(dim=1).max()) * omega * frames / settle
    waves = np.abs(np.fft.rfft(last[:, 2] - last[:, 2].mean()))
    exact = SHELL[fabric][folds - 4]
    found = shadow(last)
    inner = math.pi * (FABRIC**2 - scene.inner**2) * mass
    return run.result(found / exact - 1, drape=found, exact=exact, folds_found=int(waves.argmax()),
                      low=float(last[:, 2].min()), high=float(last[:, 2].max()), length=bending_length(mass, stiffness),
                      weight=float(points.mass.sum()) / inner, residual=speed / (omega * width),
                      span=2 * float(place[:, 2].abs().max()) / dx, points=len(place))  # fmt: skip
