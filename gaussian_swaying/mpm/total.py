"""The ``total`` formulation: stencils at the rest positions, nodal displacement and velocity as the state."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.rigid import centre, fitted_gradient
from gaussian_swaying.kernels.graphs import RECORDED
from gaussian_swaying.kernels.language import triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm import total_kernels as kernels
from gaussian_swaying.mpm.boundary import FACE, Boundary
from gaussian_swaying.mpm.contact import ContactRun, ContactStage, Surface
from gaussian_swaying.mpm.damping import kelvin_voigt_pk1
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.formulation import Formulation, Pinned, Settings, flowing, pinned_share, safe_inverse
from gaussian_swaying.mpm.pins import (
    PINNED_ALONE,
    POINTS,
    SOFTENED,
    InKernels,
    PinnedPoints,
    PinnedRegion,
    PinnedRows,
    kind_in_total,
)
from gaussian_swaying.mpm.run import INTERPRETED, Part, Run, check_indices
from gaussian_swaying.mpm.sheets import bending_of, director_energy, in_plane_stress, stress_of_sheets
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.transfer import bspline_stencil, gather, scatter, shifts
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
        self.pinned = tuple(
            held if held is None or not self.on_nodes[k] else self._on_nodes(k, held)
            for k, held in enumerate(self.pinned)
        )
        self.rigid_bodies = [self._body(k) for k in self.rigid]
        self._check_bodies()
        softened = self.soften()
        self.bending = bending_of(points, self.stencil, settings.dx, softened)
        if self.bending is not None:
            assert points.bending is not None
            assert points.normal is not None
            self.normal = torch.where((points.bending.detach() > 0)[..., None], points.normal, 0.0)
            self.bending_rate = self.bending.fastest(self.node_inverse_mass)
        self.pinned_rows = self._pinned_rows()
        self.contact = self._contact()

    def restiffened(self, points: MaterialPoints) -> Total | None:
        if self.bending is not None:
            return None
        other = copy.copy(self)
        vars(other).pop("longest_substep", None)
        other.points, other.laws = points, LawDispatch(points)
        other.soften()
        return other

    def _summed(self, values: Tensor) -> Tensor:
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

    def soften(self) -> Tensor | None:
        """Reduce the stiffness of material that clamps hold all the time; return the factors (``pins.SOFTENED``).

        None if there is none.
        """
        masks = [
            held.mass > 0
            for kind, held, boundary in zip(self.kinds, self.pinned, self.boundaries, strict=True)
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
        for kind, held in zip(self.kinds, self.pinned, strict=True):
            if kind == FACE and held is not None and held.share is not None:
                still = still | (held.share > held.threshold)
        among = torch.stack(rigid).any(0) if rigid else torch.zeros_like(still)
        rows = PinnedRows(self, still, among, self.stencil, self.grid, self.node_inverse_mass)
        return rows if rows.C.numel() else None  # a clamp that holds everything has no face

    def _body(self, k: int) -> _RigidNodes:
        held = self.pinned[k]
        assert held is not None
        assert held.share is not None
        rest, mass = in_double(self.node_positions(self.node_mass)), in_double(self.node_mass)
        return _RigidNodes(held.mass > 0, rest, torch.where(held.share > held.threshold, mass, 0.0))

    def _check_bodies(self) -> None:
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

    def _on_nodes(self, k: int, held: Pinned) -> Pinned:
        boundary, face = self.boundaries[k], self.kinds[k] == FACE
        share = self._summed(held.mass[..., None])[..., 0] * self.node_inverse_mass
        threshold = PINNED_ALONE if face else boundary.pinned_share
        if threshold is not None and not face and not bool((share > threshold).any()):
            count = int((held.mass > 0).sum())
            raise ValueError(
                f"The pin {k} holds {count} particles but no grid node: they do not have more than "
                f"{threshold:g} of the mass of any node; enlarge `region` of the {type(boundary).__name__}."
            )
        if held.release is not None:
            return replace(held, threshold=threshold or 0.0)
        holds = share > (threshold or 0.0)
        nodes = holds.reshape(-1, holds.shape[-1]).any(0).nonzero()[:, 0]
        return replace(held, share=share, threshold=threshold or 0.0, nodes=nodes)

    def first_grid(self, margin: int) -> GridSpec:
        return self.grid

    def first_state(self, velocity: Tensor, margin: int) -> MPMState:
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
        """The state with rigid parts exactly in shape, and sheets in plane stress.

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
        if self.pinned_rows is not None:
            velocity, more = self.pinned_rows.hold(velocity, displacement, time, dt)
            taken = taken + more.reshape(taken.shape)
        return velocity, taken

    def share_at(self, time: Tensor) -> partial[Tensor]:
        """The function for ``constrain`` that returns the share of the nodal mass of held particles at a time."""
        return partial(pinned_share, stencil=self.stencil, inverse_mass=self.node_inverse_mass, time=time)

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
        """Energy of bending and of transverse shear of sheets [J]; the laws have the membrane's."""
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


# time per particle for a number of lanes per cell, relative to 32 lanes, on an H200
_LANE_COST = {4: 1.5, 8: 1.0, 16: 1.0, 32: 1.0, 64: 0.85}

# least number of pieces that `total` cuts its cells into: about the number of warps that an H200 runs at once
_PROGRAMS = 2048

_BENT = 4
"""Cells of a program that bends sheets, on a GPU; measured."""

REGISTERS = 128
"""Most registers of a thread of the particles' kernel: spilling some is worth it, because more warps run at once."""


class TotalRun(Run):
    """Substeps of the ``total`` formulation; everything but the nodal fields is constant.

    Args:
        bound: The formulation, bound to its material.
    """

    fixed_order = True
    bound: Total

    def __init__(self, bound: Total) -> None:
        super().__init__(bound)
        points, stencil, grid = bound.points, bound.stencil, bound.grid
        self.grid = grid
        # with virtual nodes a cell is cut by the copies of its nodes that the particles have
        unit = stencil.cell
        order = torch.argsort(unit, stable=True)
        cells, sizes = torch.unique_consecutive(unit[order], return_counts=True)
        self.virtual = stencil.nodes is not None
        self.cell_nodes = cells.new_zeros(27, 0).int()
        """The nodes of each cell, shape (27, cells), where they are not those of the lattice."""
        if stencil.nodes is not None:
            example = order[sizes.cumsum(0) - sizes]
            cells, self.cell_nodes = stencil.first[example], stencil.nodes[:, example].int().contiguous()
        self.order, self.cells = order.int(), len(cells)
        ends = sizes.cumsum(0)
        self.cell_start = torch.cat([ends.new_zeros(1), ends]).int()
        self.cell_node = cells.int()
        self.cell_scene = (cells // grid.node_count).int()
        self.particle_cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), sizes).int()
        self.fraction = stencil.fraction[:, order].contiguous()
        rows = [points.volume, bound.laws.mu, bound.laws.lam, points.mass]
        self.material = torch.stack([row.reshape(-1) for row in rows])[:, order].contiguous()
        self.law = self.law[order].contiguous()
        self.values = torch.zeros(0, self.count, **self.like)
        self.rest = points.position.contiguous()
        inverse = bound.node_inverse_mass.reshape(-1)
        active = (inverse > 0).nonzero()[:, 0]
        self.active, self.inverse_mass = active.int(), inverse[active].contiguous()
        self.damped = bound.node_damping is not None
        self.rates = self.inverse_mass if bound.node_damping is None else bound.node_damping.reshape(-1)[active]
        if self.virtual:
            rank = torch.zeros(len(inverse), dtype=torch.long, device=self.device)
            rank[active] = torch.arange(len(active), device=self.device)
            self.source = _sources_of(self.cell_nodes.long(), rank, inverse > 0)
        else:
            place = torch.full((len(inverse),), self.cells, dtype=torch.int32, device=self.device)
            place[cells] = torch.arange(self.cells, dtype=torch.int32, device=self.device)
            below = [active - shift for shift in shifts(grid).tolist()]
            self.source = _sources(
                torch.stack([torch.where(b >= 0, place[b.clamp(min=0)], self.cells) for b in below]), self.cells
            )
        self.fields = torch.zeros(len(inverse), 8, **self.like)
        self.displacement, self.velocity = self.fields[:, :4], self.fields[:, 4:]
        self.lanes = lanes(self.device, _lanes(sizes))
        self.cut(sizes, lanes(self.device, _PROGRAMS, 1))
        nodes = (*points.position.shape[:-2], grid.node_count, 3)
        vector, matrix = points.position.shape, torch.Size((*points.position.shape, 3))
        self.shapes = {"position": vector, "velocity": vector, "affine": matrix, "F": matrix}
        self.shapes |= {"displacement": torch.Size(nodes), "node_velocity": torch.Size(nodes)}
        self.room = sum(map(_padded, self.shapes.values()))
        """Entries of a buffer for all fields of a state."""
        self.found = torch.zeros(self.room if self.count <= RECORDED else 0, **self.like)
        self.taken_and_done = torch.zeros(self.impulse.numel() + self.scenes, dtype=torch.float64, device=self.device)
        pins = (PinnedRegion, PinnedPoints)
        self.plain = all(
            kind == "surface" or (type(b) in pins and b.always and not b.moves)
            for b, kind in zip(bound.boundaries, bound.kinds, strict=True)
        )
        """True if the kernels apply all boundaries but obstacles, which are contact."""
        self.position = bound.needs_position
        self.lattice = bound.node_positions(self.rest) if bound.needs_lattice else None
        self._take_sheets()
        self._take_pins()
        self.touching = None if bound.contact is None else ContactRun(bound.contact, self.fields, self.active)
        self.shift = torch.zeros(len(inverse) if self.position else 0, 4, **self.like)
        # a CPU sums the cells around a node by a kernel of its own (`total_join`), without the last row of each of the
        # 27, which is of no cell
        self.joins = lanes(self.device, 16, 1) == 1
        joined = self.source[:, : None if self.joins else 0]
        self.source_counts = (joined % (self.cells + 1) != self.cells).sum(0, dtype=torch.int32)
        self.joined = torch.zeros(joined.shape[1], 8, **self.like)
        self.alone = torch.arange(len(self.joined), dtype=torch.int32, device=self.device)
        self._partial: dict[tuple[int, int, str], Tensor] = {}
        width = 8 if self.position else 4
        check_indices(max(8 * len(inverse), 27 * (self.pieces + 1) * width, 27 * len(active)))

    @property
    def launches(self) -> bool:
        return self.plain and (self.touching is None or None not in self.touching.solids)

    def restiffen(self, bound: Total) -> None:
        self.bound = bound
        for row, values in zip(self.material[1:3], (bound.laws.mu, bound.laws.lam), strict=True):
            row.copy_(values.reshape(-1)[self.order.long()])

    def _take_sheets(self) -> None:
        bending = self.bound.bending
        self.bent, self.normals = 0, self.fraction
        if bending is None:
            return
        self.normals = self.bound.normal.reshape(-1, 3)[self.order.long()].T.contiguous()
        place = torch.empty(self.count, dtype=torch.long, device=self.device)
        place[self.order.long()] = self.particle_cell.long()
        self.bent, self.bent_cell = len(bending.node), place[bending.example].int()
        self.bent_node = bending.node.int().contiguous()
        rows = torch.nn.functional.pad(bending.rows(), (0, 5))
        self.rank, self.curving = rows.shape[1], rows.contiguous()
        check_indices(self.curving.numel())

    def _bend(self, fields: Tensor, partial: Tensor, width: int) -> None:
        block = lanes(self.device, _BENT, 1)
        launch(kernels.total_bend, (-(-self.bent // block),))(
            self.bent_cell, self.bent_node, self.curving, fields, partial, self.bent, self.cells,
            WIDTH=width, RANK=self.rank, BLOCK=block, num_warps=1,
        )  # fmt: skip

    def _take_pins(self) -> None:
        bound, active = self.bound, self.active.long()
        owner = torch.full((self.bound.node_mass.numel(),), -1, device=self.device)
        for k in reversed(range(len(bound.pinned)) if self.plain else ()):  # the first pin takes the momentum
            pin = bound.pinned[k]
            if bound.on_nodes[k]:
                assert pin is not None
                assert pin.share is not None
                owner = torch.where((pin.share > pin.threshold).reshape(-1), k, owner)
        owner = owner[active]
        self.pinned = (owner >= 0).to(torch.int8)
        # momentum taken from each held node, and a row of zeros
        self.taken = torch.zeros(len(active) + 1, 4, **self.like)
        scene = active // self.grid.node_count
        self.own_nodes = [_by_scene((owner == k).nonzero()[:, 0], scene, self.scenes) for k in range(len(bound.pinned))]
        self.points: InKernels | None = None
        if self.plain and bound.pinned_rows is not None:
            self.points = bound.pinned_rows.in_kernels(self.like["dtype"])
            check_indices(self.points.push.numel())
            self.residual = torch.zeros(2, self.points.node.shape[1], 4, **self.like)  # now, and its sum

    def cut(self, sizes: Tensor, programs: int) -> None:
        """Split crowded cells into pieces, so that a body of few cells has enough programs to fill a GPU."""
        most = self.lanes * max(1, -(-self.count // (self.lanes * programs)))
        counts = -(-sizes // most)
        first = counts.cumsum(0) - counts
        cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), counts)
        self.pieces = len(cell)
        within = torch.arange(self.pieces, device=self.device) - first[cell]
        self.piece_start = torch.cat([self.cell_start[cell] + most * within, self.cell_start[-1:]]).int()
        self.piece_node, self.piece_scene = self.cell_node[cell].contiguous(), self.cell_scene[cell].contiguous()
        self.piece_nodes = self.cell_nodes[:, cell if self.virtual else cell[:0]].contiguous()
        self.first_piece = torch.cat([first, first.new_tensor([self.pieces])]).int()

    def _take_values(self, values: Tensor) -> None:
        if len(self.values) < values.shape[1]:
            self.repeater.forget()  # recordings read the old one
            self.values = torch.zeros(values.shape[1], self.count, **self.like)
        self.values[: values.shape[1]].copy_(values[self.order.long()].T)

    def sums(self, rows: int, width: int, use: str = "") -> Tensor:
        """Buffer for the sums of each cell or piece of a cell, with a row of zeros at the end."""
        if (rows, width, use) not in self._partial:
            self._partial[rows, width, use] = torch.zeros(27, rows + 1, width, **self.like)
        return self._partial[rows, width, use]

    def join_pieces(self, pieces: Tensor, cells: Tensor, width: int) -> None:
        block = lanes(self.device, 8, 1)
        launch(kernels.total_pieces, (-(-self.cells // block), 27))(
            pieces, cells, self.first_piece, self.cells, self.pieces, WIDTH=width, BLOCK=block, num_warps=1
        )

    def _run(self, state: MPMState, part: Part) -> dict[str, Any]:
        fastest, touching = self.speed.clone(), self.touching
        found = self._once(state, part)
        while touching is not None and not touching.fits():  # again, with more room
            self.speed.copy_(fastest)
            self.time.copy_(state.time)
            found = self._once(state, part)
        return self._fields(found, self.taken_and_done.clone(), part)

    def _once(self, state: MPMState, part: Part) -> Tensor:
        for to, value in zip((self.displacement, self.velocity), state.nodal, strict=True):
            to[:, :3].copy_(value.reshape(-1, 3))
        options = part.options
        if self.touching is not None:
            self.touching.take(self.time, self.dt, part.steps)

        def begin(_: int) -> None:
            self.begin(len(self.schedule) - 2, part.loaded)
            more = [] if self.touching is None or not self.touching.walls else [self.touching.pressed_sum]
            for buffer in (self.taken, self.impulse, *more, *([] if self.points is None else [self.residual])):
                buffer.zero_()

        key = (part.loaded, self.places(), part.key)
        self.repeater.run(1, ("begin", *key), begin, part.key is not None)
        same = (*options.values(), *(() if self.touching is None else self.touching.key))
        done = 0
        due, touching = range(0), self.touching
        if touching is not None:
            due = touching.due(part.steps)
        for mark in sorted({*part.looks, part.steps, *due}):
            self.repeat(mark - done, same, lambda offset: self.substep(offset, options))
            done = mark
            if mark in part.looks:
                self.repeater.run(1, "look", lambda _: self._look(), launches=True)
            if mark in due and touching is not None:
                self.repeater.run(1, ("lists", *touching.key), touching.make_lists)
        if self.count > RECORDED:
            found = torch.empty(self.room, **self.like)
            self._read(found, part)
            return found
        self.repeater.run(1, ("read", part.loaded, options["IMPLICIT"]), lambda _: self._read(self.found, part))
        return self.found.clone()

    def _look(self) -> None:
        _, ny, nz = self.grid.resolution
        block = lanes(self.device, 128)
        launch(kernels.total_look, (-(-self.count // block),))(
            self.fraction, self.material, self.normals, self.count, self.particle_cell, self.cell_node, self.cell_nodes,
            self.cells, self.fields, self.speed,
            ny * nz, nz, 1 / self.grid.dx, WAVE=self.wave, BLOCK=block, VIRTUAL=self.virtual,
            SHEETS=self.bent > 0, num_warps=4,
        )  # fmt: skip

    def substep(self, offset: int, options: dict[str, Any]) -> None:
        if self.asked:
            self._push()
        width = 8 if self.position else 4
        partial = self.sums(self.pieces, width)
        _, ny, nz = self.grid.resolution
        per_program = lanes(self.device, max(1, 32 // self.lanes), 1)
        launch(kernels.total_particles, (-(-self.pieces // per_program),))(
            self.fraction, self.material, self.normals, self.law, self.law_table, self.values, self.force_in, self.load,
            self.order, self.count, self.piece_start, self.piece_node, self.piece_scene, self.pieces, self.piece_nodes,
            self.fields, partial,
            self.schedule, self.loads.rows, self.scenes, self.loads.buffer, self.first_step, offset,
            ny * nz, nz, *self.grid.offset, self.grid.node_count, self.grid.dx, 1 / self.grid.dx,
            self.settings.stiffness_damping,
            **options, POSITION=self.position, WIDTH=width, CELLS=per_program, LANES=self.lanes,
            VIRTUAL=self.virtual, WIDE=self.device.type == "cuda" and not INTERPRETED, SHEETS=self.bent > 0,
            num_warps=1, maxnreg=REGISTERS,
        )  # fmt: skip
        if self.pieces > self.cells:
            pieces, partial = partial, self.sums(self.cells, width)
            self.join_pieces(pieces, partial, width)
        if self.bent:
            self._bend(self.fields, partial, width)
        nodes, block = len(self.active), lanes(self.device, 16, 1)
        source, sources = self.source, len(self.source)
        if self.joins:
            launch(kernels.total_join, (nodes,))(source, self.source_counts, nodes, partial, self.joined, WIDTH=width)
            source, sources, partial = self.alone, 1, self.joined
        held = self.plain and any(self.bound.on_nodes)
        moves = self.plain and self.touching is None
        launch(kernels.total_nodes, (-(-nodes // block),))(
            self.active, source, sources, self.inverse_mass, self.rates, self.pinned, nodes, partial,
            self.fields, self.shift, self.schedule, self.first_step, offset, *self.gravity, self.taken,
            IMPLICIT=options["IMPLICIT"], POSITION=self.position, WIDTH=width,
            HELD=moves and held, MOVE=moves, DAMPED=self.damped, BLOCK=block,
            SOURCES=triton.next_power_of_2(sources), num_warps=2,
        )  # fmt: skip
        if self.touching is not None:
            self.touching.apply(self.schedule, self.first_step, offset, self.time, self.dt)
        if self.plain and not moves:
            launch(kernels.total_end, (-(-nodes // block),))(
                self.active, self.inverse_mass, self.pinned, nodes, self.fields, self.schedule, self.first_step, offset,
                self.taken, HELD=held, BLOCK=block, num_warps=4,
            )  # fmt: skip
        if self.points is not None:
            self._hold_points(self.points, offset)
        if not self.plain:
            self._constrain()
        if not self.plain or self.asked or (self.touching is not None and self.touching.walls):
            self.pass_time()

    def _hold_points(self, points: InKernels, offset: int) -> None:
        rows, block = points.node.shape[1], lanes(self.device, 4, 1)
        launch(kernels.total_rows, (-(-rows // block),))(
            points.node, points.weight, rows, self.fields, self.residual, BLOCK=block, num_warps=1
        )
        nodes, block = len(points.affected), lanes(self.device, 2, 1)
        launch(kernels.total_hold, (-(-nodes // block),))(
            points.affected, points.scene, points.push, self.residual, nodes, points.push.shape[1], self.fields,
            self.schedule, self.first_step, offset, BLOCK=block, ROWS=lanes(self.device, 128), num_warps=1,
        )  # fmt: skip

    def _impulse(self) -> Tensor:
        total = self.impulse.reshape(self.scenes, -1, 3).clone()
        if any(self.bound.on_nodes) and self.plain:
            for k, nodes in enumerate(self.own_nodes):
                total[:, k] += self.taken[nodes, :3].sum(1, dtype=torch.float64)
        if self.touching is not None:
            self.touching.add_taken(total)
        if self.points is not None:
            held = self.residual[1, :, :3].double().reshape(self.scenes, 1, -1, 3)
            total += (self.points.share[..., None] * held).sum(2)  # a product of matrices depends on threads
        return total.reshape(self.impulse.shape)

    def _constrain(self) -> None:
        bound, inverse = self.bound, self.bound.node_inverse_mass
        shape = (*inverse.shape, 3)
        # nodes without mass keep no velocity from a boundary
        velocity = torch.where(inverse[..., None] > 0, self.velocity[:, :3].reshape(shape), 0.0)
        position = lattice = None
        if bound.node_rest is not None:
            position = bound.node_rest + self.shift[:, :3].reshape(shape)
        if self.lattice is not None:
            lattice = self.lattice + self.displacement[:, :3].reshape(shape)
        displacement = self.displacement[:, :3].reshape(shape)
        velocity, taken = bound.hold(velocity, displacement, position, lattice, self.time, self.dt)
        self.impulse.add_(taken)
        self.velocity[:, :3].copy_(velocity.reshape(-1, 3))
        self.displacement.addcmul_(self.velocity, self.dt.to(self.velocity.dtype))

    def _read(self, found: Tensor, part: Part) -> None:
        to = self._views(found)
        kick, implicit = self.schedule[0, 3:], part.options["IMPLICIT"]
        self._read_into(to["position"], to["velocity"], to["affine"], to["F"], kick, part.loaded, implicit)
        to["displacement"].view(-1, 3).copy_(self.displacement[:, :3])
        to["node_velocity"].view(-1, 3).copy_(self.velocity[:, :3])
        taken = self.impulse.numel()
        self.taken_and_done[:taken].copy_(self._impulse().reshape(-1))
        if part.loaded:
            self.taken_and_done[taken:].copy_(self._work().reshape(-1))

    def _views(self, found: Tensor) -> dict[str, Tensor]:
        views, first = {}, 0
        for name, shape in self.shapes.items():
            views[name] = found[first : first + shape.numel()].view(shape)
            first += _padded(shape)
        return views

    def _fields(self, found: Tensor, taken_and_done: Tensor, part: Part) -> dict[str, Any]:
        views, taken = self._views(found), self.impulse.numel()
        F, work = views["F"], {"work": taken_and_done[taken:].view(self.bound.points.mass.shape[:-1])}
        return {
            **{name: views[name] for name in ("position", "velocity", "affine", "node_velocity")},
            "node_displacement": views["displacement"],
            "F_elastic": F,
            "F_total": F,
            "impulse": taken_and_done[:taken].view(self.impulse.shape),
            **(work if part.loaded else {}),
        }

    def _read_into(
        self, position: Tensor, velocity: Tensor, affine: Tensor, F: Tensor, kick: Tensor, work: bool, implicit: bool
    ) -> None:
        _, ny, nz = self.grid.resolution
        block = lanes(self.device, 128)
        launch(kernels.total_read, (-(-self.count // block),))(
            self.fraction, self.material, self.normals, self.load, self.order, self.rest, self.count,
            self.particle_cell, self.cell_node, self.cell_nodes, self.cells, self.fields, kick,
            position, velocity, affine, F,
            ny * nz, nz, 1 / self.grid.dx,
            WORK=work, IMPLICIT=implicit, BLOCK=block, VIRTUAL=self.virtual, SHEETS=self.bent > 0, num_warps=4,
        )  # fmt: skip

    def _look_at(self) -> MPMState:
        shape = self.bound.points.position.shape
        position, velocity = (self._room(name, *shape) for name in ("position", "velocity"))
        affine, F = (self._room(name, *shape, 3) for name in ("affine", "F"))
        self._read_into(position, velocity, affine, F, self.schedule, False, False)
        lost = self._room("lost", *shape[:-1], dtype=torch.bool)
        nodes = self.displacement[:, :3].reshape(self.shapes["displacement"])
        return MPMState(
            position=position,
            velocity=velocity,
            affine=affine,
            F_elastic=F,
            F_total=F,
            lost=lost,
            time=self.time,
            grid=self.grid,
            node_displacement=nodes,
        )


def _padded(shape: torch.Size) -> int:
    """Entries of a field in a buffer with several, each of which starts at a multiple of 16 bytes."""
    return -(-shape.numel() // 4) * 4


def _sources(cell: Tensor, cells: int) -> Tensor:
    """Rows of the sums that each node adds, shape (most of a node, nodes).

    A node of a sheet has far fewer than 27 cells with particles around it.

    Args:
        cell: The cell in each of the 27 places around each node, shape (27, nodes); ``cells`` where there is none.
    """
    none = cell == cells
    most = int((~none).sum(0).amax()) if none.shape[1] else 0  # material too light has no nodes
    first = none.byte().argsort(dim=0, stable=True)[:most]  # in the order of the places
    return (first * (cells + 1) + cell.gather(0, first)).int()


def _sources_of(nodes: Tensor, rank: Tensor, has_mass: Tensor) -> Tensor:
    """As :func:`_sources`, for cells whose nodes are not those of the lattice.

    Args:
        nodes: The nodes of each cell, shape (27, cells).
        rank: Place of each node among those with mass, shape (all nodes,).
        has_mass: Which nodes have mass, shape (all nodes,).
    """
    cells = nodes.shape[1]
    place, cell = has_mass[nodes].nonzero().unbind(1)  # in the order of the places
    row, to = place * (cells + 1) + cell, rank[nodes[place, cell]]
    order = to.argsort(stable=True)
    row, to = row[order], to[order]
    many = to.bincount(minlength=int(has_mass.sum()))
    within = torch.arange(len(to), device=to.device) - (many.cumsum(0) - many)[to]
    found = to.new_full((int(many.max()) if len(many) else 0, len(many)), cells)  # a row of zeros
    found[within, to] = row
    return found.int()


def _lanes(sizes: Tensor) -> int:
    """Return the number of lanes per cell (one synchronisation).

    It gives the least total work, empty lanes included. A small body takes as long as its slowest program, so there it
    is large enough that no program has to go through its cells twice.
    """
    lanes, most = list(_LANE_COST), sizes.amax()[None]
    costs = torch.stack([(-(-sizes // n)).sum() * n for n in lanes])
    *work, largest = torch.cat([costs, most]).tolist()
    for n in lanes:
        if largest <= n and len(sizes) <= _PROGRAMS * max(1, 32 // n):
            return n
    return min(zip(lanes, work, strict=True), key=lambda pair: pair[1] * _LANE_COST[pair[0]])[0]


def _by_scene(nodes: Tensor, scene: Tensor, scenes: int) -> Tensor:
    """The nodes of each scene as rows, for sums in a fixed order, filled up with the place after the last node.

    Args:
        nodes: Places among the active nodes, which are sorted by scene, shape (n,).
    """
    counts = scene[nodes].bincount(minlength=scenes)
    rows = torch.full((scenes, int(counts.amax()) if len(nodes) else 0), len(scene), device=nodes.device)
    rank = torch.arange(len(nodes), device=nodes.device) - (counts.cumsum(0) - counts)[scene[nodes]]
    rows[scene[nodes], rank] = nodes
    return rows
