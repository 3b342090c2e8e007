"""The ``updated`` formulation: stencils at the current positions, momentum on the particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import matmul3, polar_rotation
from gaussian_swaying.geometry.rigid import centre
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.damping import kelvin_voigt_pk1
from gaussian_swaying.mpm.formulation import (
    MAX_NODES,
    Formulation,
    Settings,
    held_share,
    not_finite,
    safe_inverse,
)
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.transfer import bspline_stencil, g2p, scatter, scatter_momentum


class Updated(Formulation):
    """The paper's formulation: APIC (Jiang et al. 2015) on a moving grid.

    Args:
        points: See :class:`Formulation`.
        boundaries: See there.
        settings: Numbers and switches of the solver.
        surface: See :class:`Formulation`.
    """

    name = "updated"
    neighbours_fixed = False
    viscous_power = 2

    def __init__(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], settings: Settings, surface: Surface | None = None
    ) -> None:
        super().__init__(points, boundaries, settings, surface)
        if points.damping is not None:
            raise ValueError(
                "`damping` of material points, which `material.damping_ratio` sets, needs `solver.formulation: total`: "
                "use `solver.damping`, one rate for all of the material."
            )
        if points.bending is not None:
            raise ValueError(
                "`bending` of material points, which `material.bending` sets, needs `solver.formulation: total`: leave "
                "it out, or use `scene.layers: 3`."
            )
        if surface is not None and surface.contact is not None:
            raise ValueError(
                "`contact` needs particles that keep their neighbours, which the updated formulation does not have: "
                "leave out `contact`, as its material meets itself on the grid, or set `solver.formulation` to total."
            )

    def first_grid(self, margin: int) -> GridSpec:
        """The grid around the body at rest; ValueError if rounding would lose the motion of a substep."""
        position, dx = self.points.position, self.settings.dx
        farthest = float(position.detach().abs().amax()) if position.numel() else 0.0
        limit = 1e-3 * dx / torch.finfo(position.dtype).eps
        if farthest > limit:
            raise ValueError(
                f"Expected `position` within {limit:.3g} m of the origin, but got {farthest:.3g} m, where "
                f"{position.dtype} rounds by more than a thousandth of a cell: shift the scene to the origin (SimFrame "
                "does this), or use float64."
            )
        return self.bounding_grid(position, margin)

    def fit_grid(self, state: MPMState, horizon: float, margin: int) -> MPMState:
        """The state with a grid large enough for ``horizon`` seconds at twice the current speeds, with gravity."""
        dx, gravity = self.settings.dx, self.settings.gravity
        speed = float(torch.linalg.vector_norm(state.velocity.detach(), dim=-1).amax())
        if not math.isfinite(speed):
            raise not_finite("speed", state.velocity.detach().square().sum(-1).reshape(-1, 1))
        reach = (2 * speed + 0.5 * sum(g * g for g in gravity) ** 0.5 * horizon) * horizon
        cells = 3 + margin + min(int(reach / dx), 1000)
        grid = self.bounding_grid(state.position, cells, speed)
        if not state.position.is_cuda:
            return state.replace(grid=grid)
        # CUDA graphs are recorded for one grid, so keep it as long as it is large enough
        roomy = grid.with_room(state.grid)
        serves = state.grid.holds(grid) and state.grid.node_count <= 3 * roomy.node_count
        if serves and not margin:  # callers give a margin if the grid was too small
            return state
        return state.replace(grid=roomy if roomy.node_count <= MAX_NODES else grid)

    def step(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        """One substep: momenta to the nodes, their new velocity, and back to the particles, which move with it."""
        points, laws, settings = self.points, self.laws, self.settings
        stencil = bspline_stencil(state.position, state.grid, deterministic=settings.deterministic)
        F = state.F_elastic
        stress = laws.kirchhoff(F, state.internal)
        if settings.stiffness_damping > 0:
            rate = matmul3(state.affine, F)
            viscous = kelvin_voigt_pk1(F, rate, laws.mu, laws.lam, settings.stiffness_damping)
            stress = stress + matmul3(viscous, F.mT)
        kick = kick_time(state, dt)
        impulse = None if force is None else kick * force
        if any(settings.gravity):  # here and not on the nodes, because most nodes may be empty
            weight = kick * points.mass[..., None] * self.gravity.to(F)
            impulse = weight if impulse is None else impulse + weight
        if drag is not None:
            held = (kick * drag)[..., None] * state.velocity
            impulse = held if impulse is None else impulse + held
        nodes = scatter_momentum(
            points.mass, state.velocity, state.affine, impulse, kick * points.volume[..., None, None] * stress, stencil
        )
        inverse_mass = safe_inverse(nodes[..., 3])[..., None]
        velocity = nodes[..., :3] * inverse_mass
        if drag is not None:
            velocity = velocity * (1 / (1 + kick * scatter(stencil, drag[..., None, None]) * inverse_mass))
        velocity = self.decay(velocity, kick)
        position = None
        if self.needs_position or self.needs_lattice:
            position = state.grid.node_positions(velocity).expand_as(velocity)
        share = partial(held_share, stencil=stencil, inverse_mass=inverse_mass[..., 0], time=state.time)
        velocity, taken = self.constrain(velocity, nodes[..., 3], share, position, position, state.time, dt)
        new_velocity, affine, gradient = g2p(velocity, stencil)
        identity = torch.eye(3, dtype=gradient.dtype, device=gradient.device)
        update = identity + dt * gradient
        F, internal = matmul3(update, F), state.internal
        F_total = F
        if laws.plastic:
            F_total = matmul3(update, state.F_total)
            F, internal = laws.return_map(F, internal, dt)
        after = state.replace(
            position=state.position + dt * new_velocity,
            velocity=new_velocity,
            affine=affine,
            F_elastic=F,
            F_total=F_total,
            lost=state.lost | ~stencil.inside,
            time=state.time + dt,
            internal=internal,
            substep=dt,
            impulse=state.impulse + taken,
        )
        return self.in_shape(after)

    def in_shape(self, state: MPMState) -> MPMState:
        """The state with the particles of rigid parts exactly where these are: c + R (X - C), with R as their F."""
        rest = in_double(self.points.position)
        for k in self.rigid:
            held = self.held[k]
            assert held is not None
            own, mass = (held.mass > 0)[..., None], in_double(held.mass)
            whole, before = mass.sum(-1)[..., None, None], centre(rest, mass)
            mean = (mass[..., None, None] * in_double(state.F_total)).sum(-3) / whole.clamp(min=1e-300)
            rotation = polar_rotation(mean)
            place = centre(in_double(state.position), mass) + (rest - before) @ rotation.mT
            F = rotation.to(state.F_total)[..., None, :, :]
            total = torch.where(own[..., None], F, state.F_total)
            same = state.F_elastic is state.F_total
            state = state.replace(
                position=torch.where(own, place.to(state.position), state.position),
                F_elastic=total if same else torch.where(own[..., None], F, state.F_elastic),
                F_total=total,
            )
        return state

    def kinetic(self, state: MPMState) -> Tensor:
        """Energy of the particles; the affine part adds dx²/4 of its square (lumped APIC energy; Jiang et al. 2015)."""
        spread = 0.25 * self.settings.dx**2 * state.affine.square().sum((-1, -2))
        return 0.5 * (self.points.mass * (state.velocity.square().sum(-1) + spread)).sum(-1)

    def momenta(self, state: MPMState) -> tuple[Tensor, Tensor]:
        mass = self.points.mass
        momentum = mass[..., None] * state.velocity
        # contribution of the affine velocity: the antisymmetric part of m C dx²/4 (Jiang et al. 2015)
        spin = state.affine * (mass * self.settings.dx**2 / 4)[..., None, None]
        own = torch.stack([spin[..., i, j] - spin[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
        angular = torch.linalg.cross(state.position, momentum, dim=-1) + own
        return momentum.sum(-2), angular.sum(-2)
