r"""The ``modes`` formulation: a body that sways about its rest, as the amplitudes of a few modes.

A displacement of the nodes is :math:`u_i = \tilde R(\psi_i q)\, \phi_i q` with the amplitudes q, the shapes
:math:`\phi` and rotations :math:`\psi` of the modes (:mod:`~gaussian_swaying.mpm.modal`), and
:math:`\tilde R(w) = \int_0^1 R(s w)\, ds`: modal warping (Choi & Ko 2005, IEEE TVCG 11:91), so that leaves turn instead
of growing. A rigid turn is exact. Velocities are :math:`R\, \phi\, \dot q` and loads :math:`\phi^T R^T f`, so the power
of a force is that of its load.

Each mode is stepped exactly under a load that is constant in a substep, with its own damping. Forces act on *sites*,
the points that have the same nodes, in the middle of a substep; their drag acts at the mean velocity of the substep
(one small system of equations).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import vectors
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.launch import lanes, launch, replaces
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.damping import decay_rate
from gaussian_swaying.mpm.device_functions import DeviceFunction, Packed
from gaussian_swaying.mpm.forces import Force, added, split, tensors_of
from gaussian_swaying.mpm.formulation import Settings, flowing
from gaussian_swaying.mpm.modal import Analysis, analysis_of
from gaussian_swaying.mpm.modal_kernels import amplitude, factors, warp
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion, RigidRegion
from gaussian_swaying.mpm.shared_kernels import site_forces
from gaussian_swaying.mpm.state import MaterialPoints, MPMState, State
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.mpm.transfer import gather, scatter

MOST_LEAN = 0.4  # over the longest side, that modes can show
MOST_MODES = 80
LONGEST, SHORTEST = 0.01, 0.0025
"""Longest and shortest substep [s]: 4 and 16 in a frame of 0.04 s."""
PER_PERIOD = 20
"""Substeps in a period of the first mode, between these limits."""


class Modes(Total):
    """Modes of ``total`` at rest: for a held elastic body that sways by less than some 40 % of its size.

    Args:
        points: See :class:`Formulation`.
        boundaries: See there.
        settings: Numbers and switches of the solver.
        surface: See :class:`Formulation`.

    Attributes:
        square: Squares of the circular frequencies of the modes [1/s²], shape (..., M).
        ratio: Damping ratios of the modes, shape (..., M).
        first: First circular frequency [rad/s], the highest of all scenes.

    Raises:
        ValueError: If nothing holds the body, something touches it, a boundary moves it, or a law is plastic.
    """

    name = "modes"

    def __init__(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], settings: Settings, surface: Surface | None = None
    ) -> None:
        why = why_not_modes(points, boundaries, surface)
        if why is not None:
            raise ValueError(f"`solver.formulation: modes` is for a held body that sways about its rest, but {why}.")
        super().__init__(points, boundaries, settings, surface)
        self.analyse()

    @torch.no_grad()
    def analyse(self) -> None:
        scenes = max(1, math.prod(self.points.mass.shape[:-1]))
        self._bind([analysis_of(self, scene, MOST_MODES) for scene in range(scenes)])

    def _bind(self, found: Sequence[Analysis]) -> None:
        points, batch, count = self.points, tuple(self.points.mass.shape[:-1]), self.points.count
        modes = min(len(one.square) for one in found)
        like = points.position.detach()

        def stacked(name: str, dtype: torch.dtype = like.dtype) -> Tensor:
            every = torch.stack([torch.as_tensor(getattr(one, name))[..., :modes] for one in found])
            return every.to(like.device, dtype).reshape(*batch, *every.shape[1:])

        mass = points.mass.detach().sum(-1)
        norm = mass.rsqrt()[..., None, None]
        self._norm = norm  # of the state, whose amplitudes stay where they are if the mass changes
        # all scenes have the nodes of the one with most; those that fill up are the first node, with a shape of zero
        most = max(len(one.node) for one in found)
        nodes = torch.stack(
            [torch.nn.functional.pad(torch.as_tensor(one.node), (0, most - len(one.node))) for one in found]
        )
        self.node = nodes.to(like.device).reshape(*batch, most)
        site = torch.stack([torch.as_tensor(one.site) for one in found]).to(like.device)
        sites = int(site.amax()) + 1
        self.site = site.reshape(*batch, count)
        self.sites = sites

        def padded(name: str, count: int) -> Tensor:
            rows = [torch.as_tensor(getattr(one, name))[:, :modes].reshape(-1, 3, modes) for one in found]
            every = torch.stack([torch.nn.functional.pad(row, (0, 0, 0, 0, 0, count - len(row))) for row in rows])
            return norm * every.to(like.device, like.dtype).reshape(*batch, 3 * count, modes)

        self.shape, self.turn = padded("shape", most), padded("turn", most)
        self.site_modes = torch.cat([padded("site_shape", sites), padded("site_turn", sites)], -2)
        self.site_shape = self.site_modes[..., : 3 * sites, :]
        direct = torch.stack([
            torch.nn.functional.pad(torch.as_tensor(one.direct), (0, sites - one.direct.shape[1])) for one in found
        ])  # fmt: skip
        self.direct = direct.to(like).reshape(*batch, *direct.shape[1:])
        self.site_mass = self.at_sites(points.mass.detach()[..., None])[..., 0]
        self.site_rest = self._mean_at_sites(points.position.detach())
        own = points.volume.detach()
        modulus = (points.youngs_modulus.detach() * own).sum(-1) / own.sum(-1)
        self.reaction = (modulus * mass.rsqrt())[..., None, None, None] * stacked("reaction")
        unit = in_double(modulus / mass)
        firsts = torch.tensor([one.first for one in found], dtype=torch.float64, device=unit.device)
        self.firsts = (firsts.reshape(batch) * unit).sqrt()
        self.first = float(self.firsts.amax())
        square = stacked("square", torch.float64)
        if self.settings.pivot:
            second = torch.tensor([one.second for one in found], device=unit.device).reshape(*batch, 1)
            square = square.scatter(-1, second, firsts.reshape(*batch, 1))
        self._square = in_double(square) * unit[..., None]
        self._unlost = torch.zeros(self.site_mass.shape, dtype=torch.bool, device=like.device)
        self.dropped = max(one.dropped for one in found)
        self._site_forces: Any = None
        self._forces: WeakKeyDictionary[Force, Force | None] = WeakKeyDictionary()

    def restiffened(self, points: MaterialPoints) -> Modes | None:
        other = super().restiffened(points)
        if isinstance(other, Modes):
            for name in ("_shares", "ratio"):
                vars(other).pop(name, None)
            other.analyse()
        return other  # type: ignore[return-value]

    # ---- numbers that may have a gradient

    @property
    def square(self) -> Tensor:
        """Squares of the circular frequencies [1/s²], shape (..., M), float64.

        Their derivatives by the stiffness and mass of each point are those of the Rayleigh quotient of each mode.
        """
        points = self.points
        square = self._square
        E, mass = points.youngs_modulus, points.mass
        if not torch.is_grad_enabled() or not (E.requires_grad or mass.requires_grad):
            return square
        stored, moved = self._shares
        stiffer = ((in_double(E) / in_double(E.detach()) - 1)[..., None] * stored).sum(-2)
        heavier = ((in_double(mass) / in_double(mass.detach()) - 1)[..., None] * moved).sum(-2)
        return square * (1 + stiffer) / (1 + heavier)

    @property
    def inertia(self) -> Tensor:
        """Modal masses, all one, shape (..., M); they carry the gradient of the masses."""
        mass = self.points.mass
        one = torch.ones_like(self._square)
        if not torch.is_grad_enabled() or not mass.requires_grad:
            return one
        return one + ((in_double(mass) / in_double(mass.detach()) - 1)[..., None] * self._shares[1]).sum(-2)

    @cached_property
    def _shares(self) -> tuple[Tensor, Tensor]:
        """Share of the points in the elastic and the kinetic energy of each mode, shape (..., P, M) each."""
        mu, lam, points = self.laws.mu.detach(), self.laws.lam.detach(), self.points
        modes = self.shape.shape[-1]
        field = self._everywhere(self.shape.unflatten(-2, (-1, 3)).flatten(-2))
        slope = gather(field, self.stencil).unflatten(-1, (3, modes))[..., 1:4, :, :]
        speed = gather(field.unflatten(-1, (3, modes)).square().sum(-2), self.stencil)[..., 0, :]
        strain = 0.5 * (slope + slope.transpose(-3, -2))
        trace = strain.diagonal(dim1=-3, dim2=-2).sum(-1)
        density = 2 * mu[..., None] * strain.square().sum((-3, -2)) + lam[..., None] * trace.square()
        stored = in_double(points.volume.detach()[..., None] * density)
        moved = in_double(points.mass.detach()[..., None] * speed)
        return stored / stored.sum(-2, keepdim=True).clamp(min=1e-300), moved

    @cached_property
    def ratio(self) -> Tensor:
        """Damping ratios of the modes, shape (..., M), float64: of the material, and of the solver's two dampings."""
        rate = self.settings.damping / 2 + self._square * (self.settings.stiffness_damping / 2)
        found = rate / self._square.sqrt().clamp(min=1e-12)
        damping = self.points.damping
        if damping is None:
            return found
        own = in_double(damping.detach()) / decay_rate(1.0, 1.0)
        return found + (own[..., None] * self._shares[1]).sum(-2)

    # ---- sites

    def at_sites(self, values: Tensor) -> Tensor:
        """Sums of values of the points (..., P, K) over the sites, shape (..., S, K)."""
        index = self.site[..., None].expand_as(values)
        return values.new_zeros(*values.shape[:-2], self.sites, values.shape[-1]).scatter_add(-2, index, values)

    def _grouped(self, force: Force) -> Force | None:
        if force not in self._forces:
            self._forces[force] = force.on_sites(self.site, self.sites)
        return self._forces[force]

    def _mean_at_sites(self, values: Tensor) -> Tensor:
        mass = self.points.mass.detach()[..., None]
        return self.at_sites(mass * values) / self.site_mass[..., None].clamp(min=torch.finfo(mass.dtype).tiny)

    def _kernel(self, state: MPMState, groups: Sequence[Force | None], time: Tensor, dt: float, steps: int) -> Any:
        device_functions = [force.device_function() for force in groups if force is not None]
        given = [state.position, *tensors_of([force for force in groups if force is not None]), *self.tensors()]
        if not device_functions or None in device_functions or not replaces((state.position,)):
            return None
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*state.tensors(), *given)):
            return None
        if self._site_forces is None:
            with torch.inference_mode(False):
                self._site_forces = SiteForces(self.site_rest)
        with torch.inference_mode(False), torch.no_grad():
            self._site_forces.prepare(device_functions, time, dt, steps)
        return self._site_forces

    def _site_state(self, moved: Tensor, time: Tensor) -> State:
        shift, turn = moved.unflatten(-2, (2, -1, 3)).unbind(-4)
        turn = turn[..., 0]
        R = rotation_of(turn)
        velocity = _turned(R, shift[..., 1])
        moved = shift[..., 0]
        place = self.site_rest + moved + 0.5 * torch.linalg.cross(turn, moved)  # second order, for the wind there
        return State(position=place, velocity=velocity, F_elastic=R, F_total=R, lost=self._unlost, time=time)

    # ---- steps

    def first_state(self, velocity: Tensor, margin: int) -> MPMState:
        """The state at time zero, with the initial velocity projected on the modes."""
        state = super().first_state(velocity, margin)
        p = self._project(self.node_mass[..., None] * state.nodal[1])
        return self.shown(state, torch.zeros_like(p), p)

    def shown(self, state: MPMState, q: Tensor, p: Tensor) -> MPMState:
        """The state whose nodes and points follow from modal amplitudes and their rates, shape (..., M)."""
        shift = _vectors(self.shape, torch.stack([q, p], -1))
        turn = _vectors(self.turn, q[..., None])[..., 0]
        moved = torch.cat([warped(turn, shift[..., 0]), _turned(rotation_of(turn), shift[..., 1])], -1)
        displacement, velocity = self._everywhere(moved).split(3, -1)
        state = state.replace(modal=self._norm * torch.stack([q, p], -2))
        return self.in_shape(self.read_particles(state, displacement.contiguous(), velocity.contiguous()))

    def _everywhere(self, values: Tensor) -> Tensor:
        """Values of the nodes that move (..., N, K) on all nodes, zero on the others, shape (..., G, K)."""
        index = self.node[..., None].expand_as(values)
        shape = (*values.shape[:-2], self.grid.node_count, values.shape[-1])
        return values.new_zeros(shape).scatter_add(-2, index, values)

    def _project(self, nodal: Tensor) -> Tensor:
        """Loads or momenta of the nodes (..., G, 3) on the modes, shape (..., M)."""
        own = nodal.gather(-2, self.node[..., None].expand(*self.node.shape, 3)).flatten(-2)
        return (own[..., None, :] @ self.shape)[..., 0, :]

    def amplitudes(self, state: MPMState) -> tuple[Tensor, Tensor]:
        """Amplitudes [m sqrt(kg)] and their rates, shape (..., M) each; those of another solver are projected."""
        if state.modal is not None and state.modal.shape[-1] == self.shape.shape[-1]:
            own = state.modal / self._norm
            return own[..., 0, :], own[..., 1, :]
        displacement, velocity = (self._project(self.node_mass[..., None] * value) for value in state.nodal)
        return displacement, velocity

    def rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Sequence[Force],
        watch: Callable[[int], None] | None = None,
    ) -> MPMState:
        q, p = self.amplitudes(state)
        middle = state.time + 0.5 * dt
        groups = [self._grouped(force) for force in forces]
        kernel = self._kernel(state, groups, middle, dt, steps)
        acting = [] if kernel else [(one, one.during(middle, dt, steps)) for one in groups if one is not None]
        square, inertia, ratio = self.square, self.inertia, self.ratio
        alpha = ratio * square.sqrt()
        swing = on_tensors(factors)(square, alpha, dt)
        gain = (swing[1] / inertia).to(q)  # of the velocity by a load
        own = [x.to(q) for x in swing]
        back, still = square.to(q) * own[1], (square * inertia).to(q)
        gravity = self.gravity.to(q)
        work, impulse, drag, solve = state.work, state.impulse, None, None
        lagging = self._lagging(state, forces, groups)
        for k in range(steps):
            time = state.time + (k + 0.5) * dt
            weighs = any(self.settings.gravity)
            moved = self.site_modes @ torch.stack([q + 0.5 * dt * p, p], -1)
            seen = None if kernel and not weighs else self._site_state(moved, time)
            if kernel is not None:
                found = kernel(moved, k)
                load, resistance = found[..., 3:6], found[..., 6]
                outer = self._of_sites(found[..., :3])
            else:
                assert seen is not None
                given, resistance = added([split(source(seen, k), force, seen) for force, source in acting])
                load = torch.zeros_like(seen.velocity) if given is None else given
                outer = self._pull(seen.F_total, load)
            general = None if lagging is None else lagging(q, p, state.time + k * dt)
            if solve is None:
                drag, solve = self._drag(resistance, general, gain)
            if general is not None:
                outer, load = outer + general[0], load + general[2]
            pulled = outer
            if weighs:
                assert seen is not None
                weight = self.site_mass[..., None] * gravity
                pulled, load = outer + self._pull(seen.F_total, weight), load + weight
            free = own[2] * p - back * q + gain * pulled
            new = free if drag is None else free + solve(-0.5 * gain * _product(drag, free - p))
            if drag is not None:
                lost = 0.5 * _product(drag, new - p)
                outer, pulled = outer - lost, pulled - lost
            after = on_tensors(amplitude)(q, p, pulled / still, own[0], own[1])
            work = work + in_double(outer * (after - q)).sum(-1)
            mean = 0.5 * (q + after)
            taken = (self.reaction @ mean[..., None, :, None])[..., 0] + self.direct @ load
            impulse = impulse + dt * in_double(taken)
            q, p = after, new
            if watch is not None:
                watch(k + 1)
        state = state.replace(time=state.time + steps * dt, substep=dt, work=work, impulse=impulse)
        return self.shown(state, q, p)

    @torch.no_grad()
    def leaning(self, force: Force, rounds: int = 40) -> MPMState:
        """The equilibrium under a steady force, by damped iteration."""
        state = self.first_state(torch.zeros_like(self.points.position), 0)
        q, p = self.amplitudes(state)
        group, square = self._grouped(force), self.square.to(q)
        assert group is not None
        for _ in range(rounds):
            seen = self._site_state(self.site_modes @ torch.stack([q, p], -1), state.time)
            load, _ = split(group(seen), group, seen)
            assert load is not None
            q = 0.5 * (q + self._pull(seen.F_total, load) / square)
        return self.shown(state, q, p)

    def _pull(self, R: Tensor, load: Tensor) -> Tensor:
        """The load on the modes by forces on the sites, shape (..., M)."""
        return self._of_sites((R.mT @ load[..., None])[..., 0])

    def _of_sites(self, local: Tensor) -> Tensor:
        """The load on the modes by forces on the sites in their own axes, shape (..., M)."""
        return (local.flatten(-2)[..., None, :] @ self.site_shape)[..., 0, :]

    def _drag(
        self, resistance: Tensor | None, general: tuple[Tensor, Tensor | None, Tensor] | None, gain: Tensor
    ) -> tuple[Tensor | None, Callable[[Tensor], Tensor]]:
        drag = None
        if resistance is not None:
            weight = resistance.repeat_interleave(3, -1)[..., None]
            drag = self.site_shape.mT @ (weight * self.site_shape)
        if general is not None and general[1] is not None:
            drag = general[1] if drag is None else drag + general[1]
        if drag is None:
            return None, lambda x: x
        identity = torch.eye(drag.shape[-1], dtype=drag.dtype, device=drag.device)
        factor = torch.linalg.lu_factor(identity + 0.5 * gain[..., None] * drag)
        return drag, lambda x: torch.linalg.lu_solve(*factor, x[..., None])[..., 0]

    def _lagging(
        self, state: MPMState, forces: Sequence[Force], groups: Sequence[Force | None]
    ) -> Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor | None, Tensor]] | None:
        others = [force for force, group in zip(forces, groups, strict=True) if group is None]
        if not others:
            return None

        def at(q: Tensor, p: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
            now = self.shown(state.replace(time=time), q, p)
            turn = self._everywhere(_vectors(self.turn, q[..., None])[..., 0])
            load, drag = added([split(force(now), force, now) for force in others])
            load = torch.zeros_like(now.velocity) if load is None else load
            pulled = self._project(_turned(rotation_of(-turn), scatter(self.stencil, load[..., None, :])))
            if drag is None:
                return pulled, None, self.at_sites(load)
            lumped = scatter(self.stencil, drag[..., None, None])[..., 0].gather(-1, self.node)
            lumped = lumped.repeat_interleave(3, -1)[..., None]
            return pulled, self.shape.mT @ (lumped * self.shape), self.at_sites(load)

        return at

    # ---- measures and limits

    def frame_steps(self, seconds: float) -> int:
        """Number of substeps in some seconds: 4 to 16 in a frame of 0.04 s, by the first frequency."""
        period = 2 * math.pi / max(self.first, 1e-12)
        return max(1, math.ceil(seconds / min(max(period / PER_PERIOD, SHORTEST), LONGEST) - 1e-9))

    def stable_substep(self, state: MPMState | None) -> float:
        return math.inf

    @cached_property
    def longest_substep(self) -> float:
        return math.inf

    def cells_per_second(self, state: MPMState) -> Tensor:
        """Zero: waves are not stepped."""
        return torch.zeros((), dtype=torch.float64, device=state.time.device)

    def kinetic(self, state: MPMState) -> Tensor:
        """Kinetic energy of the modes [J]."""
        return 0.5 * (self.inertia * in_double(self.amplitudes(state)[1]).square()).sum(-1)

    def elastic(self, state: MPMState) -> Tensor:
        """Elastic energy of the modes [J]."""
        return 0.5 * (self.square * self.inertia * in_double(self.amplitudes(state)[0]).square()).sum(-1)


def why_not_modes(points: MaterialPoints, boundaries: Sequence[Boundary], surface: Surface | None) -> str | None:
    """Return the reason why a body cannot sway by modes; None if it can."""
    if surface is not None:
        return "it touches itself or an obstacle: set it to total"
    if points.bending is not None:
        return "`material.bending` makes it a sheet, which folds: set it to total"
    if (flows := flowing(points)) is not None:
        return f"the law {flows} flows: set it to updated"
    held = False
    for boundary in boundaries:
        if isinstance(boundary, RigidRegion):
            continue
        if not _holds_still(boundary):
            return f"the {type(boundary).__name__} moves it, or does not hold it all the time: set it to total"
        held = True
    return None if held else "nothing holds it: pin a part of it, or set it to total"


def _holds_still(boundary: Boundary) -> bool:
    still = type(boundary).forward is PinnedRegion.forward or isinstance(boundary, PinnedPoints)
    return still and boundary.always and not boundary.moves and boundary.release_time(torch.zeros(1, 3)) is None


def warped(turn: Tensor, shift: Tensor) -> Tensor:
    r"""A displacement rotated progressively: :math:`\int_0^1 R(s w)\, ds\; d` (Choi & Ko 2005, equation 13).

    Args:
        turn: Rotation w of a place, axis times angle [rad], shape (..., 3).
        shift: Its displacement d by a linear mode [m], shape (..., 3).

    Returns:
        Shape (..., 3).
    """
    return vectors(on_tensors(warp)(turn.unbind(-1), shift.unbind(-1)))


def _vectors(shape: Tensor, amplitudes: Tensor) -> Tensor:
    """Vectors of nodes or sites (..., N, 3, K) from shapes (..., 3N, M) and amplitudes (..., M, K)."""
    return (shape @ amplitudes).unflatten(-2, (-1, 3))


def _turned(R: Tensor, vectors: Tensor) -> Tensor:
    return (R @ vectors[..., None])[..., 0]


def _product(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


class SiteForces:
    """The buffers of the kernel of a body's sites.

    Args:
        rest: Places of the sites at rest [m], shape (..., S, 3).
    """

    def __init__(self, rest: Tensor) -> None:
        self.rest, self.sites = rest.contiguous(), rest.shape[-2]
        self.loads = Packed(rest.shape[:-1], {"dtype": rest.dtype, "device": rest.device})
        self.values = rest.new_zeros(1)

    def prepare(self, forces: Sequence[DeviceFunction], time: Tensor, dt: float, steps: int) -> None:
        """Take the numbers of the forces for some substeps.

        Args:
            time: Time at which the first one acts [s], scalar float64 tensor.
        """
        values = self.loads.take(forces, steps)
        if values is not None:
            self.values = values.to(self.rest).T.contiguous()
        self.loads.begin(time, torch.full_like(time, dt), steps)

    def __call__(self, moved: Tensor, step: int) -> Tensor:
        """The forces in a substep: in the axes of a site and in space [N], and the resistance [kg/s].

        Args:
            moved: Displacements and turns of the sites, and their rates, shape (..., 6 S, 2).

        Returns:
            Shape (..., S, 8), the last column unused.
        """
        loads, count, out = self.loads, self.rest.shape[:-1].numel(), moved.new_empty(*self.rest.shape[:-1], 8)
        block = lanes(moved.device, 128)
        with torch.cuda.device_of(out):
            launch(site_forces, (-(-count // block),))(
                moved.contiguous(), self.rest, self.values, loads.rows, loads.buffer, out, count, self.sites,
                loads.scenes, step, FORCES=loads.layout, BLOCK=block, num_warps=4,
            )  # fmt: skip
        return out
