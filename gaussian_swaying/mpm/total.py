"""The ``total`` formulation: stencils at the rest positions, nodal displacement and velocity as the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.rigid import centre, fitted_gradient
from gaussian_swaying.mpm.boundary import FACE, Boundary
from gaussian_swaying.mpm.contact import ContactStage, Surface
from gaussian_swaying.mpm.damping import kelvin_voigt_pk1
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.formulation import Formulation, Held, Settings, flowing, held_share, safe_inverse
from gaussian_swaying.mpm.pins import PINNED_ALONE, POINTS, SOFTENED, PinnedRows, kind_in_total
from gaussian_swaying.mpm.sheets import bending_of, director_energy, in_plane_stress, stress_of_sheets
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.transfer import bspline_stencil, gather, scatter
from gaussian_swaying.mpm.virtual_nodes import VirtualNodes, virtual_nodes


class Total(Formulation):
    """Total Lagrangian MPM (de Vaucorbeil, Nguyen & Hutchinson 2020): everything but the nodal fields is constant.

    Args:
        points: See :class:`Formulation`.
        boundaries: See there.
        settings: Numbers and switches of the solver.
        surface: See :class:`Formulation`.

    Attributes:
        grid: The nodes.
        stencil: Support of the particles at rest.
        virtual: Copies of nodes for connected parts, or None.
        node_mass: Mass of each node [kg], shape (..., G).
        node_inverse_mass: Its inverse [1/kg], 0 for a node without mass, shape (..., G).
        node_rest: Centre of the mass that each node carries, at rest [m], shape (..., G, 3), if a boundary needs node
            positions.
        node_damping: Rate at which the velocity of each node decays, the mean over its mass [1/s], shape (..., G); None
            for a material without damping of its own.
        bending: Bending of sheets of one layer, or None.
        normal: Unit normals of their points at rest, zero elsewhere, shape (..., P, 3), if there are such sheets.
        contact: Contact with obstacles and itself, or None.

    Raises:
        ValueError: If a law is plastic, a pin holds nothing or the grid is too large.
    """

    name = "total"
    neighbours_fixed = True
    viscous_power = 1

    def __init__(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], settings: Settings, surface: Surface | None = None
    ) -> None:
        super().__init__(points, boundaries, settings, surface)
        position, flows = points.position, flowing(points)
        if flows is not None:
            raise ValueError(
                f"The law {flows} flows, which the total formulation does not support: set "
                "`solver.formulation` to updated, or choose an elastic law."
            )
        self.grid = self.bounding_grid(position, margin=0)
        snap = torch.finfo(position.dtype).eps ** 0.5
        self.virtual = self._virtual_nodes(snap)
        if self.virtual is not None:
            self.grid = replace(self.grid, virtual=self.virtual.original.shape[1])
        nodes = None if self.virtual is None else self.virtual.node
        self.stencil = bspline_stencil(position, self.grid, False, snap, settings.deterministic, nodes)
        self.node_mass = self._summed(points.mass[..., None])[..., 0]
        self.node_inverse_mass = safe_inverse(self.node_mass)
        self.node_damping: Tensor | None = None
        if points.damping is not None:
            carried = self._summed((points.mass * points.damping).detach()[..., None])[..., 0]
            self.node_damping = carried * self.node_inverse_mass.detach()
        self.node_rest: Tensor | None = None
        if self.needs_position:
            first_moment = self._summed(points.mass[..., None] * position)
            self.node_rest = first_moment * self.node_inverse_mass[..., None]
        self.held = tuple(
            held if held is None or not self.on_nodes[k] else self._on_nodes(k, held)
            for k, held in enumerate(self.held)
        )
        self.rigid_bodies = [self._body(k) for k in self.rigid]
        self._check_bodies()
        softened = self._soften()
        self.bending = bending_of(points, self.stencil, settings.dx, softened)
        if self.bending is not None:
            assert points.bending is not None
            assert points.normal is not None
            self.normal = torch.where((points.bending.detach() > 0)[..., None], points.normal, 0.0)
            self.bending_rate = self.bending.fastest(self.node_inverse_mass)
        self.pinned = self._pinned_rows()
        self.contact = self._contact()

    def _summed(self, values: Tensor) -> Tensor:
        """Sums of values of the particles (..., P, K) by nodes (..., G, K); also on a GPU in a fixed order."""
        return scatter(self.stencil, values[..., None, :], fixed_order=True)

    def _virtual_nodes(self, snap: float) -> VirtualNodes | None:
        points = self.points
        if points.attached is None:
            return None
        first = bspline_stencil(points.position.detach(), self.grid, False, snap).first
        scenes = math.prod(points.mass.shape[:-1])
        number = torch.arange(scenes, device=first.device).repeat_interleave(points.count)
        return virtual_nodes(first - number * self.grid.node_count, self.grid, points.attached, scenes)

    def node_positions(self, like: Tensor) -> Tensor:
        """Positions of the nodes [m], shape (G, 3), or with virtual ones (..., G, 3); type and device of ``like``."""
        lattice = self.grid.node_positions(like)
        if self.virtual is None:
            return lattice
        more = lattice[self.virtual.original]
        every = torch.cat([lattice.expand(len(more), *lattice.shape), more], 1)
        return every.reshape(*self.points.mass.shape[:-1], *every.shape[1:])

    def hold_kind(self, k: int) -> str:
        return kind_in_total(self, k)

    def _soften(self) -> Tensor | None:
        """Reduce the stiffness of material that clamps hold all the time; return the factors (``pins.SOFTENED``).

        None if there is none.
        """
        masks = [
            held.mass > 0
            for kind, held, boundary in zip(self.kinds, self.held, self.boundaries, strict=True)
            if kind == FACE and held is not None and boundary.always
        ]
        if not masks:
            return None
        own = torch.stack(masks).any(0)
        E = self.points.youngs_modulus
        self.laws = LawDispatch(replace(self.points, youngs_modulus=torch.where(own, SOFTENED * E, E)))
        return torch.where(own, SOFTENED, 1.0)

    def _pinned_rows(self) -> PinnedRows | None:
        if not any(kind in POINTS for kind in self.kinds):
            return None
        still, rigid = torch.zeros_like(self.node_mass, dtype=torch.bool), [body.mass > 0 for body in self.rigid_bodies]
        for kind, held in zip(self.kinds, self.held, strict=True):
            if kind == FACE and held is not None and held.share is not None:
                still = still | (held.share > held.threshold)
        among = torch.stack(rigid).any(0) if rigid else torch.zeros_like(still)
        rows = PinnedRows(self, still, among, self.stencil, self.grid, self.node_inverse_mass)
        return rows if rows.C.numel() else None  # a clamp that holds everything has no face

    def _body(self, k: int) -> _RigidNodes:
        held = self.held[k]
        assert held is not None
        assert held.share is not None
        rest, mass = in_double(self.node_positions(self.node_mass)), in_double(self.node_mass)
        return _RigidNodes(held.mass > 0, rest, torch.where(held.share > held.threshold, mass, 0.0))

    def _check_bodies(self) -> None:
        """Raise ValueError if two rigid parts share nodes."""
        for k, body in enumerate(self.rigid_bodies):
            for other, before in enumerate(self.rigid_bodies[:k]):
                if bool(((body.mass > 0) & (before.mass > 0)).any()):
                    names = [repr(_region(self.boundaries[self.rigid[i]])) for i in (other, k)]
                    raise ValueError(
                        f"Two rigid parts touch, and would not hold each other: that {names[0]} and that {names[1]}; "
                        "make them one part, or put soft material between."
                    )

    def _contact(self) -> ContactStage | None:
        surface = self.surface
        if "surface" not in self.kinds and (surface is None or surface.contact is None):
            return None
        if surface is None:
            surface = Surface.of_points(self.points)
        inverse, nodes = self.node_inverse_mass, None
        if self.virtual is not None:
            nodes = self.stencil.first, self.virtual.node
        return ContactStage(surface, self.boundaries, self.kinds, self.grid, inverse, nodes)

    def _on_nodes(self, k: int, held: Held) -> Held:
        """Return the particles that the ``k``-th boundary holds, with their constant share of the mass of each node."""
        boundary, face = self.boundaries[k], self.kinds[k] == FACE
        share = self._summed(held.mass[..., None])[..., 0] * self.node_inverse_mass
        threshold = PINNED_ALONE if face else boundary.held_share
        if threshold is not None and not face and not bool((share > threshold).any()):
            count = int((held.mass > 0).sum())
            raise ValueError(
                f"The pin {k} holds {count} particles but no grid node: they do not have more than "
                f"{threshold:g} of the mass of any node; enlarge `region` of the {type(boundary).__name__} or lower "
                "its `held_share`."
            )
        if held.release is not None:
            return replace(held, threshold=threshold or 0.0)
        holds = share > (threshold or 0.0)
        nodes = holds.reshape(-1, holds.shape[-1]).any(0).nonzero()[:, 0]
        return replace(held, share=share, threshold=threshold or 0.0, nodes=nodes)

    def first_grid(self, margin: int) -> GridSpec:
        return self.grid

    def first_state(self, velocity: Tensor, margin: int) -> MPMState:
        """The state at time zero, with velocities interpolated from the nodes."""
        state = super().first_state(velocity, margin)
        momentum = self._summed(self.points.mass[..., None] * velocity)
        node_velocity = momentum * self.node_inverse_mass[..., None]
        return self.read_particles(state, torch.zeros_like(node_velocity), node_velocity)

    def decay(self, velocity: Tensor, time: float) -> Tensor:
        velocity = super().decay(velocity, time)
        return velocity if self.node_damping is None else velocity * torch.exp(-time * self.node_damping)[..., None]

    def fit_grid(self, state: MPMState, horizon: float, margin: int) -> MPMState:
        """The unchanged state: the grid does not move."""
        return state

    def step(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        """One substep: forces to the nodes, their new velocity and displacement, then the particles from them."""
        if self.contact is not None:
            raise ValueError(
                "`contact` and obstacles in `total` need the kernels, which have no gradients through contact: leave "
                "`solver.transfer` on auto, give laws device functions, and on a GPU float32; or leave contact out."
            )
        displacement, before = state.nodal
        points, laws, time = self.points, self.laws, self.settings.stiffness_damping
        F, rate = state.F_elastic, state.affine
        if (
            self.rigid_bodies or self.bending is not None
        ):  # the nodes strain the particles otherwise than the state says
            raw = self.read_particles(state, displacement, before)
            F, rate = raw.F_elastic, raw.affine
        if self.bending is None:
            stress = laws.pk1(F, None)
        else:
            stress = stress_of_sheets(F, self.normal, laws.mu, laws.lam, partial(laws.pk1, internal=None))
            F, rate = in_plane_stress(F, self.normal, laws.mu, laws.lam), self._along(rate)
        if time > 0:
            viscous = kelvin_voigt_pk1(F, rate, laws.mu, laws.lam, time)
            stress = stress + (viscous if self.bending is None else self._along(viscous))
        stress = stress * points.volume[..., None, None]
        value = torch.zeros_like(state.position) if force is None else force
        node_force = scatter(self.stencil, torch.cat([value[..., None, :], -stress.mT], dim=-2))
        if self.bending is not None:
            node_force = node_force + self.bending.forces(displacement)
        inverse_mass = self.node_inverse_mass[..., None]
        kick, yielding = kick_time(state, dt), None
        if drag is not None:
            resistance = scatter(self.stencil, drag[..., None, None])
            yielding = 1 / (1 + kick * resistance * inverse_mass)
        velocity = self._accelerate(before, node_force * inverse_mass, kick, yielding)
        velocity = torch.where(inverse_mass > 0, velocity, 0.0)
        position = lattice = None
        if self.node_rest is not None:
            shift = (state.position - points.position) * points.mass[..., None]
            position = self.node_rest + scatter(self.stencil, shift[..., None, :]) * inverse_mass
        if self.needs_lattice:
            lattice = self.node_positions(velocity) + displacement
        velocity, taken = self.hold(velocity, displacement, position, lattice, state.time, dt)
        state = state.replace(time=state.time + dt, substep=dt, impulse=state.impulse + taken)
        return self.in_shape(self.read_particles(state, displacement + dt * velocity, velocity))

    def _along(self, matrix: Tensor) -> Tensor:
        """A gradient or stress without its part across sheets, (..., P, 3, 3)."""
        n = self.normal[..., None]
        return matrix - matrix @ n @ n.mT

    def in_shape(self, state: MPMState) -> MPMState:
        """The state with nodes and particles of rigid parts exactly where these are, and sheets in plane stress.

        Particles at the border of a part have a small share of nodes that are not of it.
        """
        if self.bending is not None:
            flat = in_plane_stress(state.F_elastic, self.normal, self.laws.mu, self.laws.lam)
            state = state.replace(F_elastic=flat, F_total=flat)
        for body in self.rigid_bodies:
            state = body.in_shape(state, self.points.position)
        return state

    def hold(
        self,
        velocity: Tensor,
        displacement: Tensor,
        position: Tensor | None,
        lattice: Tensor | None,
        time: Tensor,
        dt: float | Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Apply all boundary conditions: see :meth:`constrain`; points are held last, and exactly."""
        velocity, taken = self.constrain(velocity, self.node_mass, self.share_at(time), position, lattice, time, dt)
        if self.pinned is not None:
            velocity, more = self.pinned.hold(velocity, displacement, time, dt)
            taken = taken + more.reshape(taken.shape)
        return velocity, taken

    def share_at(self, time: Tensor) -> partial[Tensor]:
        """The function for ``constrain`` that returns the share of the nodal mass of held particles at a time."""
        return partial(held_share, stencil=self.stencil, inverse_mass=self.node_inverse_mass, time=time)

    def _accelerate(self, velocity: Tensor, acceleration: Tensor, kick: float, yielding: Tensor | None) -> Tensor:
        """Apply the given acceleration, gravity and damping to node velocities.

        ``yielding`` is mass over mass plus implicit drag times ``kick``, shape (..., G, 1).
        """
        if any(self.settings.gravity):
            acceleration = acceleration + self.gravity.to(velocity)
        velocity = velocity + kick * (acceleration if yielding is None else yielding * acceleration)
        return self.decay(velocity, kick)

    def read_particles(self, state: MPMState, displacement: Tensor, velocity: Tensor) -> MPMState:
        """Particle fields, interpolated from nodal displacement [m] and velocity [m/s], shape (..., G, 3)."""
        rows = gather(torch.cat([displacement, velocity], dim=-1), self.stencil)
        return self.with_rows(state, displacement, velocity, rows)

    def with_rows(self, state: MPMState, displacement: Tensor, velocity: Tensor, rows: Tensor) -> MPMState:
        """As :meth:`read_particles`, from both fields interpolated, shape (..., P, 4, 6)."""
        F = rows[..., 1:4, :3].mT + torch.eye(3, dtype=rows.dtype, device=rows.device)
        return state.replace(
            position=self.points.position + rows[..., 0, :3],
            velocity=rows[..., 0, 3:],
            affine=rows[..., 1:4, 3:].mT,
            F_elastic=F,
            F_total=F,
            node_displacement=displacement,
            node_velocity=velocity,
        )

    def kinetic(self, state: MPMState) -> Tensor:
        return 0.5 * (self.node_mass * state.nodal[1].square().sum(-1)).sum(-1)

    def sheet_energy(self, state: MPMState) -> Tensor | float:
        """Energy of bending, and of what F does across sheets, whose membrane is that of the law."""
        if self.bending is None:
            return 0.0
        displacement = state.nodal[0]
        F = gather(displacement, self.stencil)[..., 1:4, :].mT
        F = F + torch.eye(3, dtype=F.dtype, device=F.device)
        own = self.points.volume * director_energy(F, self.normal, self.laws.mu)
        return self.bending.energy(displacement) + own.sum(-1)

    def momenta(self, state: MPMState) -> tuple[Tensor, Tensor]:
        displacement, velocity = state.nodal
        momentum = self.node_mass[..., None] * velocity
        place = self.node_positions(momentum) + displacement
        return momentum.sum(-2), torch.linalg.cross(place, momentum, dim=-1).sum(-2)


def _region(boundary: Boundary) -> object:
    return vars(boundary).get("region")


@dataclass(frozen=True)
class _RigidNodes:
    """A rigid part.

    Attributes:
        particles: Its particles, bool, shape (..., P).
        rest: Nodes at rest [m], float64, shape (G, 3), or with virtual ones (..., G, 3).
        mass: Mass of its nodes [kg], zero for others, float64, shape (..., G).
    """

    particles: Tensor
    rest: Tensor
    mass: Tensor

    def in_shape(self, state: MPMState, rest: Tensor) -> MPMState:
        """The state with its nodes and particles in place; ``rest`` are the particles at rest, shape (..., P, 3)."""
        displacement, velocity = map(in_double, state.nodal)
        identity = torch.eye(3, dtype=self.rest.dtype, device=self.rest.device)
        rotation = polar_rotation(identity + fitted_gradient(self.rest, displacement, self.mass))
        rate = fitted_gradient(self.rest, velocity, self.mass)
        middle, shift, speed = (centre(field, self.mass) for field in (self.rest, displacement, velocity))
        arm, turn = in_double(rest) - middle, (rotation - identity).mT
        own, whole = self.particles[..., None], self.particles[..., None, None]
        F = torch.where(whole, rotation.to(rest)[..., None, :, :], state.F_elastic)
        nodes = (shift + (self.rest - middle) @ turn).to(rest)
        return state.replace(
            position=torch.where(own, rest + (shift + arm @ turn).to(rest), state.position),
            velocity=torch.where(own, (speed + arm @ rate.mT).to(rest), state.velocity),
            affine=torch.where(whole, rate.to(rest)[..., None, :, :], state.affine),
            F_elastic=F,
            F_total=F,
            node_displacement=torch.where((self.mass > 0)[..., None], nodes, state.nodal[0]),
        )
