"""Base class of the formulations: the material of a run on a grid, and how it moves."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.groups import joined
from gaussian_swaying.geometry.linalg import largest_eigenvalue
from gaussian_swaying.mpm.boundary import CLOCK, FACE, Boundary, Nodes
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.damping import damped_substep
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState, bounding_grid
from gaussian_swaying.mpm.timestep import MAX_CFL, cfl_number, stable_limit, wave_speed
from gaussian_swaying.mpm.transfer import Stencil, scatter

_Number = TypeVar("_Number", float, Tensor)


MAX_NODES = 64_000_000
"""Largest grid; a larger one raises an error instead of filling the memory."""


@fixed
@dataclass(frozen=True, slots=True)
class Settings:
    """The solver settings that a formulation needs; ``MPMSolver`` explains the fields."""

    dx: float
    gravity: tuple[float, ...]
    damping: float
    stiffness_damping: float
    deterministic: bool
    pivot: bool = False

    def __post_init__(self) -> None:
        for name in ("dx", "damping", "stiffness_damping"):
            value = getattr(self, name)
            check_positive(name, value, allow_zero=name.endswith("damping"))
            object.__setattr__(self, name, float(value))


@dataclass(frozen=True, slots=True)
class Pinned:
    """The particles that a boundary holds, and the nodes held through them.

    Attributes:
        mass: Mass of those particles [kg], zero elsewhere, shape (..., P).
        total: Mass of all of them [kg], shape (...).
        release: Time at which each particle is released [s], shape (..., P), or None if they are not released one by
            one.
        share: Their share of the mass of each node, shape (..., G), if it is constant, else None.
        threshold: Share above which a node is held.
        nodes: The nodes that are held in any scene, shape (K,), if their share is constant, else None.
    """

    mass: Tensor
    total: Tensor
    release: Tensor | None = None
    share: Tensor | None = None
    threshold: float = 0.0
    nodes: Tensor | None = None

    def mass_at(self, time: Tensor) -> Tensor:
        """Mass of the particles that are held at a time [kg], zero elsewhere, shape (..., P)."""
        return self.mass if self.release is None else torch.where(self.release > time + CLOCK, self.mass, 0.0)


class Formulation(ABC):
    """A body bound to a grid: its first state, its substep in torch, and its limits on substep and grid.

    Everything that a substep needs besides state and forces is computed once, here, and never changes: a different
    material, device or precision needs a new object.

    Args:
        points: The material at rest.
        boundaries: Boundary conditions in metres, in order.
        settings: Numbers and switches of the solver.
        surface: Contact samples of its surface; None for the material points, which then touch obstacles only.

    Attributes:
        name: Its name in a configuration.
        neighbours_fixed: Whether particles keep their neighbours from the rest state, because the stencils do not move:
            such a body cannot tear, flow or leave its grid, and its velocity does not count in the Courant number.
        bending_rate: Largest square of a circular frequency of sheets that bend by themselves [1/s²].
        viscous_power: Power of the largest squared stretch with which the viscous stress stiffens.
        laws: The laws of the material, bound to its particles.
        held: The particles that each boundary holds; None for one that holds none.
        rigid: The places among the boundaries of those that make a part rigid.
        kinds: Kind of each boundary: ``nodes``, points as ``hinge``, ``clamp`` or ``face``, or ``surface``
            (``Boundary.hold_kind``).
        on_nodes: Whether each boundary acts on nodes, by its ``forward``; a face does so besides its points.
        needs_position: Whether a boundary uses the positions of nodes.
        needs_lattice: Whether a boundary uses the positions of lattice points.
    """

    name: ClassVar[str]
    neighbours_fixed: ClassVar[bool]
    viscous_power: ClassVar[int]
    bending_rate: float = 0.0

    def __init__(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], settings: Settings, surface: Surface | None = None
    ) -> None:
        self.points, self.boundaries, self.settings, self.surface = points, tuple(boundaries), settings, surface
        self.laws = LawDispatch(points)
        self.pinned = tuple(_held(points, boundary) for boundary in self.boundaries)
        self.rigid = [k for k, boundary in enumerate(self.boundaries) if boundary.turn == 2]
        self.kinds = tuple(self.hold_kind(k) for k in range(len(self.boundaries)))
        self.on_nodes = tuple(kind in ("nodes", FACE) for kind in self.kinds)
        nodal = [b for b, acts in zip(self.boundaries, self.on_nodes, strict=True) if acts]
        self.needs_position = any(b.needs_position for b in nodal)
        self.needs_lattice = any(b.needs_lattice for b in nodal)
        with torch.inference_mode(False):  # an ordinary tensor, which a gradient may need
            # float64 on the device: no copy in a step, full precision in a float64 run
            self.gravity = torch.tensor(settings.gravity, dtype=torch.float64, device=points.mass.device)

    @cached_property
    def pieces(self) -> list[Tensor | None]:
        """The points of each connected piece, int64, on the CPU; one entry of None if there is only one."""
        attached = self.points.attached
        if attached is None:
            return [None]
        attached = attached.cpu()
        label = attached if attached.dim() == 1 else joined(self.points.count, attached.T)
        _, of = torch.unique(label, return_inverse=True)
        many = of.bincount()
        return [None] if len(many) < 2 else list(of.argsort(stable=True).split(many.tolist()))

    def is_rigid(self) -> Tensor:
        """The particles of rigid parts, bool, shape (..., P)."""
        found = torch.zeros_like(self.points.mass, dtype=torch.bool)
        for k in self.rigid:
            held = self.pinned[k]
            assert held is not None
            found |= held.mass > 0
        return found

    def restiffened(self, points: MaterialPoints) -> Formulation | None:
        """The same body with another stiffness; None if it must be bound anew."""
        return None

    def tensors(self) -> list[Tensor]:
        """Tensors that a substep depends on, besides its state and forces; any of them may require a gradient."""
        points = self.points
        own = [points.position, points.mass, points.volume, points.youngs_modulus, points.poisson_ratio]
        own += [] if points.bending is None else [points.bending]
        return own + [t for boundary in self.boundaries for t in (*boundary.parameters(), *boundary.buffers())]

    def hold_kind(self, k: int) -> str:
        """Return what the ``k``-th boundary acts on, see ``Boundary.hold_kind``."""
        return self.boundaries[k].hold_kind(self.neighbours_fixed)

    # ---- state and grid

    @abstractmethod
    def first_grid(self, margin: int) -> GridSpec:
        """The grid of the body at rest, with ``margin`` extra cells on each side if the body moves through the grid."""

    def first_state(self, velocity: Tensor, margin: int) -> MPMState:
        """The state at time zero.

        Args:
            velocity: Initial velocity [m/s], shape (..., P, 3).
            margin: Cells around the object in the first grid, if it moves through the grid.
        """
        position = self.points.position
        identity = torch.eye(3, dtype=position.dtype, device=position.device).repeat(*position.shape[:-1], 1, 1)
        return MPMState(
            position=position,
            velocity=velocity,
            affine=torch.zeros_like(identity),
            F_elastic=identity,
            F_total=identity,
            lost=torch.zeros(position.shape[:-1], dtype=torch.bool, device=position.device),
            time=torch.zeros((), dtype=torch.float64, device=position.device),
            grid=self.first_grid(margin),
            internal=self.laws.initial_internal(),
            work=torch.zeros(position.shape[:-2], dtype=torch.float64, device=position.device),
            impulse=self.no_impulse(),
        )

    def no_impulse(self) -> Tensor:
        """A reaction impulse of zero for each boundary, shape (..., B, 3), float64."""
        position = self.points.position
        shape = (*position.shape[:-2], len(self.kinds), 3)
        return torch.zeros(shape, dtype=torch.float64, device=position.device)

    @abstractmethod
    def fit_grid(self, state: MPMState, horizon: float, margin: int) -> MPMState:
        """The state with a grid for the next ``horizon`` seconds; see ``MPMSolver.fit_grid``."""

    def bounding_grid(self, position: Tensor, margin: int, speed: float = 0.0) -> GridSpec:
        """The smallest grid that contains the stencils of all particles.

        Args:
            position: Particle position [m], shape (..., P, 3).
            speed: Largest speed [m/s], for the error message.
        """
        dx = self.settings.dx
        flat = position.detach().reshape(-1, 3)
        low, high = flat.amin(0), flat.amax(0)
        if not bool(torch.isfinite(low).all() & torch.isfinite(high).all()):
            raise not_finite("position", flat)
        grid = bounding_grid(low, high, dx, margin)
        if grid.node_count > MAX_NODES:
            size = [round(v, 3) for v in (high - low).tolist()]
            what = f"The particles span {size} m"
            if 2 * margin * dx > max(size):
                what = f"The particles may fly {margin * dx:.3g} m in any direction within a frame, at {speed:.3g} m/s"
            raise ValueError(
                f"{what}, which takes {grid.node_count:,} grid nodes at dx = {dx:g} m, more "
                f"than {MAX_NODES:,}: select a smaller region, or coarsen `dx`."
            )
        if max(map(abs, grid.offset)) >= 2**31:
            raise ValueError(
                f"The particles lie up to {float(flat.abs().amax()):.3g} m from the origin, more than 2^31 cells of dx "
                f"= {dx:g} m: pin or enclose them, or shift the scene to the origin."
            )
        return grid

    # ---- the substep

    @abstractmethod
    def step(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        """One substep of ``dt`` [s] in torch.

        Args:
            dt: Substep [s].
            force: Force on each particle [N], shape (..., P, 3), or None.
            drag: Its resistance [kg/s], shape (..., P), or None; see ``MPMSolver.step``.

        Returns:
            The state ``dt`` later, without the work of the force.
        """

    def decay(self, velocity: Tensor, time: float) -> Tensor:
        """A velocity after ``time`` seconds of damping."""
        return velocity * math.exp(-self.settings.damping * time) if self.settings.damping > 0 else velocity

    def constrain(
        self,
        velocity: Tensor,
        mass: Tensor,
        share_of: Callable[[Pinned], Tensor],
        position: Tensor | None,
        lattice: Tensor | None,
        time: Tensor,
        dt: float | Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Apply the boundary conditions that act on nodes to their velocities, in order.

        Args:
            velocity: Node velocity after the momentum update [m/s], shape (..., G, 3).
            mass: Node mass [kg], shape (..., G).
            share_of: Returns the share of the nodal mass that held particles have now, shape (..., G).
            position: Positions of the nodes [m], shape (..., G, 3), if a boundary needs them.
            lattice: Positions of the lattice points [m], shape (..., G, 3), if a boundary needs them.
            time: Time at the start of the substep [s], scalar float64 tensor.
            dt: Substep [s], a number or a scalar float64 tensor.

        Returns:
            The velocity, shape (..., G, 3), and the momentum that each boundary took from the body [N s], shape
            (..., B, 3), float64.
        """
        taken, fixed = list(self.no_impulse().unbind(-2)), None
        acting = [k for k, acts in enumerate(self.on_nodes) if acts]
        for k in sorted(acting, key=lambda k: self.boundaries[k].turn):
            boundary, held, before = self.boundaries[k], self.pinned[k], velocity
            if held is None:
                nodes = Nodes(time, dt, position, lattice)
            else:
                share = share_of(held) if held.share is None else held.share
                known = held.threshold, held.total, mass, fixed, held.nodes
                nodes = Nodes(time, dt, position, lattice, share, *known)
            velocity = boundary(velocity, nodes)
            if self.rigid and held is not None and boundary.turn == 1:
                pinned = nodes.pinned & boundary.active(time)
                fixed = pinned if fixed is None else fixed | pinned
            with torch.no_grad():
                taken[k] = (mass[..., None] * (before - velocity)).sum(-2, dtype=torch.float64)
        return velocity, torch.stack(taken, dim=-2) if taken else self.no_impulse()

    def in_shape(self, state: MPMState) -> MPMState:
        """The state with rigid parts exactly in shape, free of round-off."""
        return state

    # ---- measures of a state

    def elastic(self, state: MPMState) -> Tensor | None:
        """Elastic energy [J], shape (...) over the batch; None if it is that of the laws at the particles."""
        return None

    @abstractmethod
    def kinetic(self, state: MPMState) -> Tensor:
        """Kinetic energy [J], shape (...) over the batch."""

    def sheet_energy(self, state: MPMState) -> Tensor | float:
        """Energy of sheets that bend by themselves [J], shape (...) over the batch."""
        return 0.0

    @abstractmethod
    def momenta(self, state: MPMState) -> tuple[Tensor, Tensor]:
        """Linear [kg m/s] and angular momentum about the origin [kg m²/s], shape (..., 3) each."""

    # ---- how long a substep may be

    def frame_steps(self, seconds: float) -> int | None:
        """Substeps for a time if any substep is stable; None to follow the fastest wave."""
        return None

    def stable_substep(self, state: MPMState | None) -> float:
        """Longest substep [s] that is stable for any arrangement of particles (one GPU synchronisation)."""
        dx, spatial = self.settings.dx, not self.neighbours_fixed
        F, internal = (None, None) if state is None else (state.F_elastic.detach(), state.internal)
        limit = stable_limit(self.points, dx, F, internal, spatial=spatial, laws=self.laws)
        shortest = (1 / float(limit.detach().amin()) ** 2 + self.bending_rate / 4) ** -0.5
        return damped_substep(shortest, self.viscous_time(state))

    @cached_property
    def longest_substep(self) -> float:
        """Substep [s] above which nothing is stable, at rest (one GPU synchronisation, the first time)."""
        mass = self.points.mass
        F = torch.eye(3, dtype=mass.dtype, device=mass.device).expand(*mass.shape, 3, 3)
        speed = wave_speed(self.points, F, self.laws.initial_internal(), laws=self.laws).detach()
        limit = MAX_CFL / self.with_bending(max(float(speed.amax()) / self.settings.dx, 1e-30))
        return damped_substep(limit, self.settings.stiffness_damping)

    def cells_per_second(self, state: MPMState) -> Tensor:
        """Return the number of cells that the fastest wave crosses per second, a scalar tensor."""
        spatial, F = not self.neighbours_fixed, state.F_elastic.detach()
        speed = wave_speed(self.points, F, state.internal, spatial=spatial, laws=self.laws)
        return self.with_bending(cfl_number(1.0, self.settings.dx, speed, state.velocity if spatial else None).detach())

    def with_bending(self, cells: _Number) -> _Number:
        r"""Courant rate that includes the bending of sheets.

        The largest circular frequency of elastic waves is at most :math:`\sqrt 6` times their cells per second
        (:mod:`~gaussian_swaying.mpm.timestep`), and squares of frequencies add up.
        """
        return (cells**2 + self.bending_rate / 6) ** 0.5 if self.bending_rate > 0 else cells

    def obstacle_cells(self, state: MPMState, seconds: float) -> float:
        """Largest number of cells per second that an obstacle on nodes crosses, within some seconds of a state.

        Such an obstacle stops the nodes that it meets, and would jump over those between two substeps. The host waits
        if there is one that moves.
        """
        pairs = zip(self.boundaries, self.kinds, strict=True)
        moving = [b for b, kind in pairs if kind == "nodes" and isinstance(b, Obstacle) and not b.still]
        if not moving:
            return 0.0
        time = float(state.time)
        place = state.position.detach()
        away = [float((place - b.motion(state.time, 1.0)[0].to(place)).norm(dim=-1).amax()) for b in moving]
        speeds = [b.fastest(far, time, time + seconds) for b, far in zip(moving, away, strict=True)]
        return max(speeds) / self.settings.dx

    def viscous_time(self, state: MPMState | None) -> float:
        """Stiffness damping [s] times the stiffening of the viscous stress by stretch."""
        time = self.settings.stiffness_damping
        if time == 0 or state is None:
            return time
        F = state.F_elastic.detach()
        squared = float(largest_eigenvalue(F.mT @ F).amax().clamp(min=1.0))
        return time * squared**self.viscous_power


def flowing(points: MaterialPoints) -> str | None:
    """The name of a law that flows; None if there is none."""
    return next((type(law).__name__ for law in points.laws if law.plastic), None)


def _held(points: MaterialPoints, boundary: Boundary) -> Pinned | None:
    position = points.position.detach()
    mask = boundary.particle_mask(position)
    if mask is None:
        return None
    mass = torch.where(mask, points.mass, 0.0)
    return Pinned(mass, mass.sum(-1), boundary.release_time(position))


def pinned_share(held: Pinned, stencil: Stencil, inverse_mass: Tensor, time: Tensor) -> Tensor:
    """Share of the mass of each node that held particles have at a time, shape (..., G).

    Args:
        inverse_mass: Inverse mass of each node [1/kg], 0 for a node without mass, shape (..., G).
        time: The time [s], scalar float64 tensor.
    """
    return scatter(stencil, held.mass_at(time)[..., None, None])[..., 0] * inverse_mass


def safe_inverse(mass: Tensor) -> Tensor:
    """1 / mass where there is mass, else 0; its derivative, 1 / mass², also stays finite."""
    floor = torch.finfo(mass.dtype).tiny ** 0.5
    return torch.where(mass > floor, 1 / mass.clamp(min=floor), 0.0)


def not_finite(name: str, values: Tensor) -> FloatingPointError:
    """The error that names the first particle with a NaN or infinite value, in ``values`` (P, ·)."""
    first = int((~torch.isfinite(values)).any(-1).int().argmax())
    return FloatingPointError(f"The {name} of particle {first} is NaN or infinite.")
