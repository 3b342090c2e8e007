"""A stiff plate hung by its top edge in a steady wind, against the equilibrium of the wind law itself."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.aero.force import LAWS, AeroForce
from gaussian_swaying.gaussians.surface import deform_patch
from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.validation.settings import Settings

GRAVITY, AIR, DRAG = 9.8, 1.225, 1.2
LENGTH, MASS = 0.5, 2.0  # height of the plate [m] and its mass per area [kg/m²]
_STRETCH = 0.004  # how much a strip of the plate would stretch under its own weight
_FRAME = 0.04


class Hinge(Boundary):
    """Holds the nodes of one grid line along x: the material turns about it.

    A pinned row of particles holds up to three rows of nodes and clamps the turn. One line of nodes does not: a rigid
    rotation about it is affine, so quadratic B-splines carry it exactly, with these nodes at rest. In ``total`` the
    line holds the material that rests there; in ``updated`` whatever passes.

    Args:
        dx: Grid spacing [m].
        y: Where the axis lies, a multiple of ``dx`` [m].
        z: The same along z [m].
    """

    needs_lattice = True

    def __init__(self, dx: float, y: float = 0.0, z: float = 0.0) -> None:
        super().__init__()
        check_positive("dx", dx)
        self.dx, self.y, self.z = float(dx), float(y), float(z)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Stop the nodes on the line."""
        assert nodes.lattice is not None
        off = (nodes.lattice[..., 1] - self.y).abs() + (nodes.lattice[..., 2] - self.z).abs()
        return torch.where((off < 1e-3 * self.dx)[..., None], torch.zeros_like(velocity), velocity)


def hinged_plate_angle(k: float, law: str) -> float:
    r"""Angle from the vertical at which a rigid plate, hinged along its top edge, rests in a horizontal wind [degrees].

    Weight and wind both act at the centre of the plate, so the moments about the hinge balance where
    :math:`m g \sin\theta` equals the normal force. ``paper``: :math:`q A C_D`, so :math:`\sin\theta = k`.
    ``projected``: :math:`q A C_D \cos\theta`, so :math:`\tan\theta = k`.

    For k >= 1 the ``paper`` law has no equilibrium short of the horizontal. There its force changes side, as the normal
    turns along the flow: the plate is driven up from below and down from above, and stays edge-on (a sliding mode).

    Args:
        k: :math:`q A C_D / (m g)` with :math:`q = \rho U^2 / 2`.
        law: ``paper`` or ``projected``.

    Returns:
        The angle.
    """
    check_choice("law", law, LAWS)
    check_positive("k", k, allow_zero=True)
    return math.degrees(math.asin(min(k, 1.0)) if law == "paper" else math.atan(k))


def hinged_plate(
    k: float,
    law: str,
    settings: Settings | None = None,
    cells: int = 8,
    seconds: float = 2.4,
    damping: float = 10.0,
    per_cell: int = 2,
) -> dict[str, Any]:
    r"""Let a stiff plate, hinged along its top edge, come to rest in a steady horizontal wind.

    The plate is one layer of particles in the x-z plane, 0.5 m high and hung from the x axis, in wind along y. At rest
    pressure balances the weight across the plate everywhere, not only on average, so that bending does not enter; its
    stiffness is chosen to keep the stretch below 0.4 %. The angle is that of the line from hinge to centre of mass.

    Args:
        k: Pressure over weight, :math:`q A C_D / (m g)`.
        law: ``paper`` or ``projected``.
        settings: Solver settings.
        cells: Grid cells along the height of the plate.
        seconds: Time to come to rest [s].
        damping: Rate at which velocities decay [1/s]; about critical for the swing.
        per_cell: Particles per cell and direction.

    Returns:
        ``angle``, ``exact`` and ``error`` [degrees], ``drift``: change of the angle in the last fifth of the time
        [degrees], ``particles``, ``simulated_s``, ``substeps`` and ``wall_s``, the time of the rollout alone [s].
    """
    settings = Settings() if settings is None else settings
    exact = hinged_plate_angle(k, law)
    dx = LENGTH / cells
    spacing = dx / per_cell
    options = {"dtype": settings.dtype, "device": settings.device}
    down = -(torch.arange(cells * per_cell, dtype=torch.float64) + 0.5) * spacing
    layer = (torch.arange(per_cell, dtype=torch.float64) + 0.5) * spacing - 0.5 * dx
    across = (torch.arange(2 * per_cell, dtype=torch.float64) + 0.5) * spacing
    points = MaterialPoints.create(
        torch.cartesian_prod(across, layer, down).to(**options),
        volume=spacing**3,
        density=MASS / dx,
        youngs_modulus=MASS / dx * GRAVITY * LENGTH / _STRETCH,
        poisson_ratio=0.3,
    )
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY), damping=damping, boundaries=[Hinge(dx)])
    state = solver.init_state(points)
    aero = AeroForce(C_D=DRAG, C_F=0.0, C_L=0.0, air_density=AIR, law=law).to(settings.device)
    normal = torch.tensor([0.0, 1.0, 0.0], **options).expand(points.count, 3)
    area = torch.full((points.count,), spacing**2 / per_cell, **options)
    speed = math.sqrt(2 * k * MASS * GRAVITY / (AIR * DRAG))
    wind = torch.tensor([0.0, speed, 0.0], **options)

    angles: list[Tensor] = []
    frames, substeps = max(5, round(seconds / _FRAME)), 0
    _synchronize(settings.device)
    begin = time.perf_counter()
    for _ in range(frames):
        steps = solver.substeps(state, _FRAME)
        state = solver.fit_grid(state, _FRAME)
        for _ in range(steps):
            force = aero(wind, state.velocity, *deform_patch(state.F_total, normal, area))
            state = solver.step(state, _FRAME / steps, force)
        substeps += steps
        centre = state.position.double().mean(-2)
        angles.append(torch.rad2deg(torch.atan2(centre[1], -centre[2])))
    _synchronize(settings.device)
    wall = time.perf_counter() - begin
    angle = float(angles[-1])
    return {
        "error": angle - exact,
        "angle": angle,
        "exact": exact,
        "drift": angle - float(angles[-1 - frames // 5]),
        "particles": points.count,
        "simulated_s": frames * _FRAME,
        "substeps": substeps,
        "wall_s": wall,
    }


def _synchronize(device: torch.device | str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()
