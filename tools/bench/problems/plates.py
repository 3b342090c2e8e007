"""A stiff plate on a hinge in a steady wind, compared with the equilibrium of the wind law."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bench.problems.settings import Axial, Result, Settings, follow, lattice
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.wind.force import AeroForce

HEIGHT, MASS, GRAVITY, AIR, DRAG = 0.5, 2.0, 9.8, 1.225, 1.2  # m below the hinge, kg/m², m/s², kg/m³, C_D
_STRETCH = 0.008  # how much a strip of the plate would stretch under its own weight
_OVERHANG = 2  # cells above the hinge
_FRAME = 0.04


class Hinge(Boundary):
    r"""Lets the material rotate about the x axis: the material on the axis does not move.

    Only the interpolated velocity on the axis is held, :math:`\sum_i w_i v_i = 0`, by subtracting it from the nodes
    around. The reaction passes through the axis, without a moment, if the material around is symmetric about it, and
    all motion is in the y-z plane, the same along x.

    Units: ``dx``, ``rest`` [m].
    """

    needs_lattice = True

    def __init__(self, dx: float, rest: Tensor | None = None) -> None:
        super().__init__()
        self.dx, self.rest = float(dx), rest

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Subtract the velocity of the axis from the nodes around it."""
        place = nodes.lattice if self.rest is None else self.rest
        assert place is not None
        y, z = (place[..., a].abs() / self.dx for a in (1, 2))
        weight = (_bspline(y) * _bspline(z))[..., None]
        # a node without mass has no velocity and no weight
        moving = weight * (velocity != 0).any(-1, keepdim=True)
        slip = (moving * velocity).sum(-2, keepdim=True) / moving.sum(-2, keepdim=True).clamp(min=1e-6)
        return torch.where(moving > 0, velocity - slip, velocity)


def _bspline(distance: Tensor) -> Tensor:
    outer = 0.5 * (1.5 - distance).clamp(min=0).square()
    return torch.where(distance < 0.5, 0.75 - distance.square(), outer)


def hinged_plate_angle(k: float, law: str) -> float:
    r"""Angle from the vertical at which a rigid plate on a hinge rests in a horizontal wind [degrees].

    Weight and wind both act at the centre of the plate, so the moments about the hinge balance where
    :math:`m g \sin\theta` equals the normal force. ``paper``: :math:`q A C_D`, so :math:`\sin\theta = k`.
    ``projected``: :math:`q A C_D \cos\theta`, so :math:`\tan\theta = k`.

    For k >= 1 the ``paper`` law has no equilibrium below the horizontal. At the horizontal its force changes sides, as
    the normal is flipped along the flow: the plate is driven up from below and down from above, and stays edge-on (a
    sliding mode).
    """
    return math.degrees(math.asin(min(k, 1.0)) if law == "paper" else math.atan(k))


def hinged_plate(
    k: float,
    law: str,
    settings: Settings | None = None,
    cells: int = 6,
    seconds: float = 3.2,
    damping: float = 6.0,
    per_cell: int = 2,
) -> Result:
    r"""Let a stiff plate on a hinge come to rest in a steady horizontal wind.

    The plate, one cell thick, hangs half a metre down from the hinge and extends a little above it. It moves in plane
    strain, in wind along y. At rest the pressure balances the weight across the plate everywhere, not only on average,
    so there is no bending. Its stiffness keeps the stretch below one percent. The angle is that of the line from the
    hinge to the centre of mass.

    Units: ``seconds`` [s].

    Returns:
        ``error`` [degrees] with its sign, ``angle`` and ``exact`` [degrees], ``drift``: change of the angle in the last
        fifth of the time [degrees], ``slip``: relative change of the distance between the centre and the hinge, and
        the common quantities.
    """
    settings = Settings() if settings is None else settings
    exact = hinged_plate_angle(k, law)
    dx = HEIGHT / cells
    density = MASS / dx
    centred = lattice(dx, (0, 0, -cells), (1, 1, _OVERHANG), settings, per_cell)
    points = MaterialPoints.create(
        centred - centred.new_tensor([0.0, 0.5 * dx, 0.0]),
        volume=(dx / per_cell) ** 3,
        density=density,
        youngs_modulus=density * GRAVITY * HEIGHT / _STRETCH,
        poisson_ratio=0.3,
    )
    hinge = Hinge(dx)
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY), damping=damping, boundaries=[Axial([0]), hinge])
    state = solver.init_state(points)
    if solver.neighbours_fixed:
        hinge.rest = state.grid.node_positions(state.position)

    like = points.position
    aero = AeroForce(C_D=DRAG, C_F=0.0, C_L=0.0, air_density=AIR, law=law).to(like.device)
    normal = like.new_tensor([0.0, 1.0, 0.0]).expand_as(like)
    area = like.new_full((points.count,), (dx / per_cell) ** 2 / per_cell)
    speed = math.sqrt(2 * k * MASS * GRAVITY / (AIR * DRAG))
    wind = like.new_tensor([0.0, speed, 0.0])

    def force(state: MPMState) -> Tensor:
        return aero(wind, state.velocity, *deform_patch(state.F_total, normal, area))

    frames = max(5, round(seconds / _FRAME))
    run = follow(solver, state, _FRAME, frames, lambda state: state.position.double().mean(-2), force)
    arm = run.series[:, 1:]
    angles = torch.rad2deg(torch.atan2(arm[:, 0], -arm[:, 1]))
    angle = float(angles[-1])
    return run.result(
        angle - exact,
        angle=angle,
        exact=exact,
        drift=angle - float(angles[-1 - frames // 5]),
        slip=float(arm[-1].norm() / arm[0].norm()) - 1,
        particles=points.count,
    )
