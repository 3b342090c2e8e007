"""Backward pass of rollouts in the ``total`` formulation, in kernels; torch's autograd of its substep is the reference.

The adjoint of a substep has the structure of the substep: the gradient by the nodal forces is gathered at the
particles, multiplied there by the derivatives of stress and force, and scattered to the nodes. So these kernels follow
those in ``total_kernels``, with the same order of particles and without atomics.

Substeps are numbered within a segment. A backward pass counts forward, from ``last`` down: its ``first_step`` is the
number of substeps that it has done. Rows of ``bars``, one per active node: gradient by displacement and by velocity,
each in four columns of eight. Rows of ``history``: displacement and velocity at the start of each substep, likewise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import add3, axpy9, dot3, load3, scale3, scale9, store3
from gaussian_swaying.kernels.derive import vjp
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.damping import kelvin_voigt
from gaussian_swaying.mpm.device_functions import Constant, device_key
from gaussian_swaying.mpm.dispatch import BodyLaws, pk1, pk1_adjoint
from gaussian_swaying.mpm.forces import Force, divide, tensors_of
from gaussian_swaying.mpm.run import MAX_STEPS, at_home
from gaussian_swaying.mpm.shared_kernels import VARIES, axis_weights, node_weight, numbers_of_force, sums, vector
from gaussian_swaying.mpm.sheets import flattened, sheet_stress, without_normal
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.total import REGISTERS, TotalRun
from gaussian_swaying.mpm.total_kernels import cells_of, gather, law_row, load_particles, motion
from gaussian_swaying.mpm.transfer import gather as gather_rows

_SHAPED = {"flat": 9, "m": 3, "area": 0, "thickness": 0, "thinning": 0}


class Adjoints(Constant):
    """Adjoints of a body's laws and force, derived on first use.

    Args:
        laws: The laws.
        force: What makes the adjoint of the force, see ``DeviceFunction``; None without force.
    """

    def __init__(self, laws: BodyLaws, force: Callable[[], Any] | None) -> None:
        self.stresses = laws.adjoints
        self.force = None if force is None else force()
        self.viscous, self.flattened, self.sheet = _derived()
        functions = (*self.stresses, self.force, self.viscous, self.flattened, self.sheet)
        self.cache_key = hashlib.sha256(repr(list(map(device_key, functions))).encode()).hexdigest()


@cache
def _derived() -> tuple[Any, ...]:
    return (
        vjp(kelvin_voigt, {"F": 9, "rate": 9, "mu": 0, "lam": 0, "time": 0}, ("F", "rate", "mu", "lam")),
        vjp(flattened, {"F": 9, "n": 3, "mu": 0, "lam": 0}, ("F", "mu", "lam")),
        vjp(sheet_stress, {"F": 9, "n": 3, "mu": 0, "P": 9, **_SHAPED}, ("F", "mu", "P", *_SHAPED)),
    )


@triton.jit(do_not_specialize=VARIES)
def keep_nodes(active, nodes, fields, history, first_step, step_offset, BLOCK: tl.constexpr):
    """Keep displacement and velocity of the active nodes at the start of a substep."""
    step = tl.load(first_step) + step_offset
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    k = place // 8
    mask = k < nodes
    node = tl.load(active + k, mask, 0)
    value = tl.load(fields + node * 8 + place % 8, mask, 0.0)
    tl.store(history + step.to(tl.int64) * nodes * 8 + place, value, mask)


@triton.jit(do_not_specialize=VARIES)
def keep_rows(residual, rows, history, first_step, step_offset, BLOCK: tl.constexpr):
    """Store the velocities that held points had in the previous substep, before they were stopped."""
    step = tl.load(first_step) + step_offset
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = place < 4 * rows
    tl.store(history + step * rows * 4 + place, tl.load(residual + place, mask, 0.0), mask)


@triton.jit
def _add(to, value, real, chunk):
    if chunk > 0:
        value += tl.load(to, real, 0.0)
    tl.store(to, value, real)


@triton.jit(do_not_specialize=VARIES)
def particles_adjoint(
    fraction, material, normals, law, law_table, values, count,
    cell_start, cell_node, cell_scene, cells, cell_nodes,
    fields, force_bar, partial, found, shares,
    vectors, scenes, numbers, first_step, step_offset, last,
    sx, sy, inverse_dx, viscous_time,
    LAWS: tl.constexpr, MULTI: tl.constexpr, FORCES: tl.constexpr, VISCOUS: tl.constexpr, MATERIAL: tl.constexpr,
    SHARES: tl.constexpr, WIDTH: tl.constexpr, CELLS: tl.constexpr, LANES: tl.constexpr,
    VIRTUAL: tl.constexpr, SHEETS: tl.constexpr, ADJOINTS: tl.constexpr,
):  # fmt: skip
    """Gradients by the nodal displacements (columns 0 to 2 of ``partial``) and velocities (4 to 6), summed by cells.

    With MATERIAL the gradients by mu, lambda and volume are added to the three rows of ``found``; with SHARES those by
    the numbers of the substep and of the force, of which there is at most one, are written to a row of eight for each
    substep and cell.
    """
    LOADED: tl.constexpr = len(FORCES.functions) > 0
    step = tl.load(last) - tl.load(first_step) - step_offset
    cell, real, start, end, node, scene, longest = cells_of(cell_start, cell_node, cell_scene, cells, CELLS)
    lane = tl.arange(0, LANES)[None, :]
    known = real[:, None]
    for chunk in range(0, longest, LANES):
        index = start[:, None] + chunk + lane
        mask = index < end[:, None]
        f, volume, mu, lam = load_particles(fraction, material, count, index, mask)
        wz, gz = axis_weights(f[2], inverse_dx)
        if VIRTUAL:
            place = tl.minimum(cell, cells - 1)[:, None]
        else:
            place = node
        _u, F, v, rate = motion(
            fields, place, sx, sy, f, wz, gz, inverse_dx, known, VISCOUS, LOADED, cell_nodes, cells, VIRTUAL
        )
        a, Q, _v = gather(force_bar, place, sx, sy, f, wz, gz, inverse_dx, known, False, cell_nodes, cells, VIRTUAL)
        row = law_row(law, law_table, index, mask, MULTI)
        if SHEETS:
            bent = F
            n = load3(normals, count, index, mask)
            F, m, area, thickness, thinning = flattened(bent, n, mu, lam)
            P = pk1(F, mu, lam, row, LAWS)
            by_bent, more_mu, by_P, by_shape, by_m, by_area, by_thickness, by_thinning = ADJOINTS.sheet(
                bent, n, mu, P, F, m, area, thickness, thinning, Q
            )
            by_F, by_mu, by_lam = pk1_adjoint(F, by_P, mu, lam, row, ADJOINTS)
            by_F = axpy9(1.0, by_F, 1.0, by_shape)
            by_mu += more_mu
            rate = without_normal(rate, n)
            Q = without_normal(Q, n)
        else:
            by_F, by_mu, by_lam = pk1_adjoint(F, Q, mu, lam, row, ADJOINTS)
        if VISCOUS:
            more, by_rate, one, two = ADJOINTS.viscous(F, rate, mu, lam, viscous_time, Q)
            by_F = axpy9(1.0, by_F, 1.0, more)
            by_mu += one
            by_lam += two
            if SHEETS:
                by_rate = without_normal(by_rate, n)
            by_rate = scale9(-volume, by_rate)
        by_F = scale9(-volume, by_F)
        by_mu *= -volume
        by_lam *= -volume
        if LOADED:
            point, own, now = numbers_of_force(
                0, FORCES, index, mask, scene, values, count, vectors, scenes, step, numbers
            )
            more, by_v, by_vector, by_numbers = ADJOINTS.force(F, v, point, own, now, numbers + FORCES.tables[0], a)
            by_F = axpy9(1.0, by_F, 1.0, more)
            if SHARES:
                to = shares + (step.to(tl.int64) * cells + cell) * 8
                for c in tl.static_range(3):
                    _add(to + c, tl.sum(tl.where(mask, by_vector[c], 0.0), 1), real, chunk)
                    _add(to + 4 + c, tl.sum(tl.where(mask, by_numbers[c], 0.0), 1), real, chunk)
        if SHEETS:
            bars = scale3(-volume, by_m) + (-volume * by_area, -volume * by_thickness, -volume * by_thinning)
            by_F, one, two = ADJOINTS.flattened(bent, n, mu, lam, by_F + bars)
            by_F = axpy9(1.0, by_F, -volume, by_bent)
            by_mu += one
            by_lam += two
        if MATERIAL:
            to = found + index
            tl.store(to, tl.load(to, mask, 0.0) + by_mu, mask)
            tl.store(to + count, tl.load(to + count, mask, 0.0) + by_lam, mask)
            # the stress is homogeneous in mu and lambda, so Q : P follows from its derivatives
            to = found + 2 * count + index
            work = (mu * by_mu + lam * by_lam) / tl.where(mask, volume, 1.0)
            tl.store(to, tl.load(to, mask, 0.0) + work, mask)
        for i in range(3):
            wx, gx = node_weight(f[0], i, inverse_dx)
            for j in range(3):
                wy, gy = node_weight(f[1], j, inverse_dx)
                w = wx * wy
                ax = gx * wy
                ay = wx * gy
                a = _across(by_F, ax, ay)
                if VISCOUS:
                    b = _across(by_rate, ax, ay)
                    if LOADED:
                        b = add3(b, w, by_v)
                for k in tl.static_range(3):
                    out = partial + (((i * 3 + j) * 3 + k) * (cells + 1) + cell) * WIDTH
                    gw = gz[k] * w
                    for c in tl.static_range(3):
                        _add(out + c, tl.sum(wz[k] * a[c] + gw * by_F[3 * c + 2], 1), real, chunk)
                        if VISCOUS:
                            _add(out + 4 + c, tl.sum(wz[k] * b[c] + gw * by_rate[3 * c + 2], 1), real, chunk)
                        elif LOADED:
                            _add(out + 4 + c, tl.sum(wz[k] * w * by_v[c], 1), real, chunk)


@triton.jit
def bend_adjoint(bent_node, fields, force_bar, found):
    """Add the gradient by a row of the matrix of a cell that bends, 32 columns of which 27 count, in a substep."""
    row = tl.program_id(0) * 27 + tl.program_id(1)
    o = tl.arange(0, 32)
    a = vector(force_bar + tl.load(bent_node + row) * 8, True)
    u = vector(fields + tl.load(bent_node + tl.program_id(0) * 27 + o, o < 27, 0) * 8, o < 27)
    to = found + row * 32 + o
    tl.store(to, tl.load(to) - (a[0] * u[0] + a[1] * u[1] + a[2] * u[2]))


@triton.jit
def _across(m, x, y):
    return (m[0] * x + m[1] * y, m[3] * x + m[4] * y, m[6] * x + m[7] * y)


@triton.jit(do_not_specialize=VARIES)
def nodes_adjoint(
    active, source, sources, inverse_mass, rates, held, nodes, partial, fields, force_bar, history, bars, mass_bar,
    schedule, first_step, step_offset, last, gravity_x, gravity_y, gravity_z,
    SUM: tl.constexpr, PUSH: tl.constexpr, FINISH: tl.constexpr, VELOCITY: tl.constexpr, HELD: tl.constexpr,
    MASS: tl.constexpr, DAMPED: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, SOURCES: tl.constexpr,
):  # fmt: skip
    """Gradients by the nodal fields, and by the forces of the substep before.

    SUM adds the sums of the particles of the later substep, whose part for the velocity exists with VELOCITY. PUSH goes
    back through the new displacement, which ends a substep. FINISH goes back through pins (HELD), damping and the new
    velocity, and puts the state at the start of the substep into ``fields``, for the particles. MASS adds the gradient
    by the inverse mass to ``mass_bar``.
    """
    step = tl.load(last) - tl.load(first_step) - step_offset
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    own = bars + k * 8
    u, v = vector(own, mask), vector(own + 4, mask)
    if SUM:
        o = tl.arange(0, SOURCES)[:, None]  # all at once
        known = mask[None, :] & (o < sources)
        row = partial + tl.load(source + o * nodes + k[None, :], known, 0) * WIDTH
        u = add3(u, 1.0, sums(vector(row, known), 0))
        if VELOCITY:
            v = add3(v, 1.0, sums(vector(row + 4, known), 0))
        store3(own, 1, 0, u, mask)
    if PUSH:
        v = add3(v, tl.load(schedule + (step + 1) * 4 + 1), u)
    if FINISH:
        kick = tl.load(schedule + (step + 1) * 4)
        decay = tl.load(schedule + (step + 1) * 4 + 2)
        if DAMPED:
            decay *= tl.exp(-kick * tl.load(rates + k, mask, 0.0))
        inverse = tl.load(inverse_mass + k, mask, 0.0)
        node = tl.load(active + k, mask, 0)
        before = history + (step.to(tl.int64) * nodes + k) * 8
        w = vector(before + 4, mask)
        store3(fields + node * 8, 1, 0, vector(before, mask), mask)
        store3(fields + node * 8 + 4, 1, 0, w, mask)
        if MASS:
            # what forces and held points added to the velocity is proportional to the inverse mass
            after = before + nodes.to(tl.int64) * 8
            rest = decay
            if HELD:
                rest = tl.where(tl.load(held + k, mask, 0) == 0, decay, 0.0)
            free = add3(w, kick, (gravity_x, gravity_y, gravity_z))
            gain = dot3(v, add3(vector(after + 4, mask), -rest, free)) / tl.where(mask, inverse, 1.0)
            tl.store(mass_bar + k, tl.load(mass_bar + k, mask, 0.0) + gain, mask)
        if HELD:
            decay = tl.where(tl.load(held + k, mask, 0) == 0, decay, 0.0)
        v = scale3(decay, v)
        store3(force_bar + node * 8, 1, 0, scale3(kick * inverse, v), mask)
    store3(own + 4, 1, 0, v, mask)


@triton.jit(do_not_specialize=VARIES)
def rows_adjoint(affected, scene, push, bars, residual, nodes, rows, BLOCK: tl.constexpr):
    """The multiplier of each held row: the transpose of what rows push, shape (rows, nodes), times the gradient."""
    row = tl.program_id(0)
    own = row // rows
    zero = tl.zeros([BLOCK], tl.float32)
    a = (zero, zero, zero)
    for start in range(0, nodes, BLOCK):
        n = start + tl.arange(0, BLOCK)
        mask = n < nodes
        mask = mask & (tl.load(scene + n, mask, -1) == own)
        b = tl.load(push + (row - own * rows) * nodes + n, mask, 0.0)
        place = bars + tl.load(affected + n, mask, 0) * 8 + 4
        a = add3(a, b, vector(place, mask))
    for c in tl.static_range(3):
        tl.store(residual + row * 4 + c, tl.sum(a[c], 0))


@triton.jit(do_not_specialize=VARIES)
def hold_adjoint(
    affected, scene, weight, residual, nodes, rows, bars,
    weight_bar, multipliers, all_rows, inverse_mass, history, active_count, first_step, step_offset, last,
    WEIGHTS: tl.constexpr, BLOCK: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Subtract the weighted rows times their multipliers from the gradient.

    WEIGHTS adds the gradient by the weights: less the forward multiplier times the gradient by the momentum, and less
    that of the gradient times the velocity after the substep.
    """
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = n < nodes
    first = tl.load(scene + n, mask, 0) * rows
    zero = tl.zeros([BLOCK], tl.float32)
    a = (zero, zero, zero)
    for start in range(0, rows, ROWS):
        k = start + tl.arange(0, ROWS)
        known = mask[:, None] & (k < rows)[None, :]
        b = tl.load(weight + n[:, None] * rows + k[None, :], known, 0.0)
        place = residual + (first[:, None] + k[None, :]) * 4
        a = add3(a, 1.0, sums(scale3(b, vector(place, known)), 1))
    own = tl.load(affected + n, mask, 0)
    at = bars + own * 8 + 4
    a = add3(vector(at, mask), -1.0, a)
    store3(at, 1, 0, a, mask)
    if WEIGHTS:
        step = tl.load(last) - tl.load(first_step) - step_offset
        inverse = tl.load(inverse_mass + own, mask, 0.0)
        after = history + ((step + 1).to(tl.int64) * active_count + own) * 8 + 4
        v = vector(after, mask)
        pushed = multipliers + step * all_rows * 4
        for start in range(0, rows, ROWS):
            k = start + tl.arange(0, ROWS)
            known = mask[:, None] & (k < rows)[None, :]
            place = (first[:, None] + k[None, :]) * 4
            held, moved = vector(residual + place, known), vector(pushed + place, known)
            to = weight_bar + n[:, None] * rows + k[None, :]
            bar = v[0][:, None] * held[0]
            for c in tl.static_range(1, 3):
                bar += v[c][:, None] * held[c]
            for c in tl.static_range(3):
                bar += (inverse * a[c])[:, None] * moved[c]
            tl.store(to, tl.load(to, known, 0.0) - bar, known)


class TotalAdjoint(TotalRun):
    """Rollouts with gradients: a backward pass in kernels, which shares the buffers and graphs of the substeps.

    The forward pass keeps displacement and velocity of the nodes every so many substeps. The backward pass runs each
    segment again, now keeping them in every substep, and then its adjoint. What the kernels do not cover is left to
    torch's autograd, which is the reference.
    """

    made = 0
    """Number of times that the buffers of a backward pass were made."""

    def _prepare(self) -> None:
        self.nodes, self.place = len(self.active), self.active.long()
        self.force_bar = torch.zeros_like(self.fields)
        self.bars, self.mass_bar, self.material_bar, self.history, self.shares = (
            torch.zeros(*shape, **self.like)
            for shape in ((self.nodes, 8), (self.nodes,), (3, self.count), (0, self.nodes, 8), (0, self.pieces, 8))
        )
        self.stiffness_bar = torch.zeros(self.bent, 27, 32, **self.like)
        self.last = torch.zeros_like(self.first_step)
        self.made = 1
        self._take_rows()

    def _take_rows(self) -> None:
        points, pinned = self.points, self.bound.pinned_rows
        if points is None or pinned is None:
            return
        place = torch.full((self.bound.node_mass.numel(),), -1, dtype=torch.int32, device=self.device)
        place[self.place] = torch.arange(self.nodes, dtype=torch.int32, device=self.device)
        self.affected, self.scene = place[points.affected.long()].contiguous(), points.scene
        self.push = points.push.T.contiguous()
        self.weight = pinned.C[0].mT[pinned.real].to(self.push).contiguous()
        self.weight_bar = torch.zeros_like(self.weight)
        self.row_bar = torch.zeros(points.node.shape[1], 4, **self.like)
        self.multipliers = self.row_history = torch.zeros(0, len(self.row_bar), 4, **self.like)

    # ---- forward

    def why_no_gradient(self, state: MPMState, forces: Sequence[Force]) -> str | None:
        """Return the reason why gradients of a rollout need torch's autograd; None if the kernels compute them."""
        bound = self.bound
        points = bound.points
        if not self.plain or self.touching is not None:
            return "boundaries other than pins that hold all the time, and contact, have no backward kernels"
        device_function = forces[0].device_function() if forces else None
        if len(forces) > 1 or (forces and device_function is None):
            return "only one force with a device function has a backward kernel"
        if device_function is not None and device_function.adjoint is None:
            return f"this {type(forces[0]).__name__} has no backward kernel"
        free = [points.mass, points.volume, points.youngs_modulus, points.poisson_ratio, points.bending]
        fixed = [t for t in bound.tensors() if not any(t is other for other in free)]
        fixed += (
            []
            if device_function is None
            else [t for t in tensors_of(forces) if any(t is source for source in device_function.sources)]
        )
        fixed += [t for law in points.laws for t in (*law.parameters(), *law.buffers())]
        if any(t.requires_grad for t in fixed):
            return "a gradient by rest positions, patches, boundaries or numbers of a law needs torch"
        nodal = (state.node_displacement, state.node_velocity)
        if any(t is not None and t.requires_grad for t in nodal):
            return (
                None if not any(_own(t, nodal) for t in state.tensors()) else "particle fields are inputs of their own"
            )
        if any(t.requires_grad for t in state.tensors()):
            return "particle fields require gradients, but the nodal ones do not"
        return None

    def rollout_with_gradient(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Sequence[Force],
        checkpoint: int,
        watch: Callable[[int], None] | None,
    ) -> MPMState:
        if steps == 0:
            return state
        if not self.made:
            with torch.inference_mode(False), torch.no_grad():
                self._prepare()
        run = _Run(self, state, dt, steps, segment(steps, checkpoint, self.nodes), tuple(forces), watch)
        vectors = numbers = None
        if forces:
            (device_function,) = divide(forces)[1]
            vectors = device_function.per_substep.take(state.time, torch.full_like(state.time, dt), steps)
            numbers = torch.as_tensor(device_function.numbers.take())
        bound = self.bound
        laws, points, pinned = bound.laws, bound.points, bound.pinned_rows
        displacement, velocity = _Rollout.apply(
            run, *state.nodal, laws.mu, laws.lam, points.volume,
            bound.node_inverse_mass, None if pinned is None else pinned.C,
            None if bound.bending is None else bound.bending.stiffness, vectors, numbers,
        )  # fmt: skip
        end = run.state
        rows = gather_rows(torch.cat([displacement, velocity], dim=-1), bound.stencil)
        return bound.in_shape(bound.with_rows(end, displacement, velocity, rows))

    def forward(self, run: _Run) -> tuple[Tensor, ...]:
        """Run all segments and keep the state at the start of each; the nodal fields at the end."""
        for first in range(0, run.steps, run.every):
            count = min(run.every, run.steps - first)
            run.starts.append(torch.stack([value.reshape(-1, 3)[self.place] for value in run.state.nodal], dim=1))
            run.kicks.append(kick_time(run.state, run.dt))
            run.state = self.rollout(run.state, run.dt, count, run.forces)[0]
            if run.watch is not None:
                run.watch(first + count)
        return tuple(value.clone() for value in run.state.nodal)

    # ---- backward

    def backward(
        self, run: _Run, bars: Sequence[Tensor], vectors: Tensor | None, numbers: Tensor | None, needs: dict[str, bool]
    ) -> dict[str, Tensor]:
        """Gradients by the inputs of :class:`_Rollout`, by name, from those by the nodal fields at the end."""
        loaded = len(run.forces) > 0
        self.asked = ()
        acting = divide(run.forces)[1]
        self.options = self.options_for(acting)
        self.adjoints = Adjoints(self.laws, acting[0].adjoint if acting else None)
        if numbers is not None:
            self.loads.buffer[: len(numbers)].copy_(numbers)
        self._make_room(run.every, loaded)
        self.width = 8 if loaded or self.options["VISCOUS"] else 4
        self.partial = self.sums(self.cells, self.width, "adjoint")
        for buffer in (
            self.bars,
            self.force_bar,
            self.mass_bar,
            self.material_bar,
            self.stiffness_bar,
            self.partial,
            self.fields,
        ):
            buffer.zero_()
        for k, bar in enumerate(bars):
            self.bars[:, 4 * k : 4 * k + 3] = bar.reshape(-1, 3)[self.place]
        shares = loaded and (needs["vectors"] or needs["numbers"])
        material = any(needs[name] for name in ("mu", "lam", "volume"))
        self.flags = {"MATERIAL": material, "SHARES": shares, "MASS": needs["inverse_mass"], "WEIGHTS": needs["weight"]}
        self.flags["BENDING"] = needs["stiffness"]
        if self.points is not None:
            self.weight_bar.zero_()
        vector_bars: list[Tensor] = []
        number_bar = torch.zeros(3, dtype=torch.float64, device=self.device)
        for n in reversed(range(len(run.starts))):
            first = n * run.every
            count = min(run.every, run.steps - first)
            if vectors is not None:
                self.loads.write(0, vectors[first : first + count])
            self.schedule[: count + 2].copy_(self.table(run.kicks[n], run.dt, count), non_blocking=True)
            self._segment(run.starts[n], count)
            if shares:
                by_vector, by_numbers = self._shared(count)
                vector_bars.append(by_vector)
                number_bar += by_numbers
        self._nodes_back(0, SUM=True, PUSH=False, FINISH=False)
        bound, found = self.bound, {}
        for k, (name, bar) in enumerate(zip(_INPUTS, bars, strict=False)):
            all_nodes = bar.reshape(-1, 3) if k == 0 else torch.zeros_like(bar).reshape(-1, 3)
            own = self.bars[:, 4 * k : 4 * k + 3].to(bar)
            found[name] = all_nodes.index_copy(0, self.place, own).reshape(bar.shape)
        sorted_back = torch.empty_like(self.material_bar)
        sorted_back[:, self.order.long()] = self.material_bar
        for name, row in zip(("mu", "lam", "volume"), sorted_back, strict=True):
            found[name] = row.reshape(bound.points.mass.shape)
        inverse = bound.node_inverse_mass
        mass = torch.zeros(inverse.numel(), **self.like).index_copy(0, self.place, self.mass_bar)
        found["inverse_mass"] = mass.reshape(inverse.shape)
        found["stiffness"] = self.stiffness_bar[:, :, :27]
        if self.points is not None and bound.pinned_rows is not None:
            weight = torch.zeros_like(bound.pinned_rows.C)
            weight[0].mT[bound.pinned_rows.real] = self.weight_bar.to(weight)
            found["weight"] = weight
        if vectors is not None and numbers is not None and vector_bars:
            by_vectors = torch.cat(vector_bars[::-1])
            by_vectors = by_vectors.reshape(vectors.shape) if vectors.ndim > 2 else by_vectors.sum(1)
            found["vectors"] = by_vectors.to(vectors)
            found["numbers"] = torch.nn.functional.pad(number_bar, (0, len(numbers) - 3)).to(numbers)
        return found

    def _segment(self, start: Tensor, count: int) -> None:
        self.fields.view(-1, 2, 4)[:, :, :3].index_copy_(0, self.place, start)
        self.first_step.zero_()

        def again(offset: int) -> None:
            self._keep(offset)
            self.substep(offset, self.options)

        def back(offset: int) -> None:
            self._node_stages(offset)
            self._particles_back(offset)

        key = (*self.options.values(), *self.flags.values(), self.adjoints, self.made)
        self.repeat(count, ("again", *key), again)
        self._keep(0)
        if self.flags["WEIGHTS"]:
            self._find_multipliers(count)
        self.last.fill_(count - 1)
        self.first_step.zero_()
        self.repeat(count, ("back", *key), back)

    def _make_room(self, every: int, loaded: bool) -> None:
        """Make the buffers for a segment; recorded graphs contain their addresses, so new buffers are counted."""
        if len(self.history) < every + 1:
            self.made += 1
            self.history = torch.zeros(every + 1, self.nodes, 8, **self.like)
            if self.points is not None:
                rows = len(self.row_bar)
                self.row_history, self.multipliers = (torch.zeros(every + 1, rows, 4, **self.like) for _ in range(2))
        if loaded and len(self.shares) < every:
            self.made += 1
            self.shares = torch.zeros(every, self.pieces, 8, **self.like)

    def _find_multipliers(self, count: int) -> None:
        pinned = self.bound.pinned_rows
        assert pinned is not None
        W = pinned.W[0]
        rates = self.row_history[1 : count + 1].reshape(count, *W.shape[:2], 4).double()
        found = torch.einsum("sij,csjx->csix", W.mT @ W, rates)
        self.multipliers[:count].copy_(found.reshape(count, -1, 4))

    def _keep(self, offset: int) -> None:
        block = lanes(self.device, 512)
        launch(keep_nodes, (triton.cdiv(8 * self.nodes, block),))(
            self.active, self.nodes, self.fields, self.history, self.first_step, offset, BLOCK=block, num_warps=4
        )
        if self.flags["WEIGHTS"]:
            rows = len(self.row_bar)
            launch(keep_rows, (triton.cdiv(4 * rows, block),))(
                self.residual, rows, self.row_history, self.first_step, offset, BLOCK=block, num_warps=4
            )

    def _node_stages(self, offset: int) -> None:
        if self.points is None:
            self._nodes_back(offset, SUM=True, PUSH=True, FINISH=True)
            return
        self._nodes_back(offset, SUM=True, PUSH=True, FINISH=False)
        nodes, rows = len(self.affected), self.push.shape[0]
        launch(rows_adjoint, (len(self.row_bar),))(
            self.affected, self.scene, self.push, self.bars, self.row_bar, nodes, rows,
            BLOCK=lanes(self.device, min(1024, triton.next_power_of_2(nodes))), num_warps=4,
        )  # fmt: skip
        block = lanes(self.device, 8, 1)
        launch(hold_adjoint, (triton.cdiv(nodes, block),))(
            self.affected, self.scene, self.weight, self.row_bar, nodes, rows, self.bars,
            self.weight_bar, self.multipliers, len(self.row_bar), self.inverse_mass, self.history, self.nodes,
            self.first_step, offset, self.last, WEIGHTS=self.flags["WEIGHTS"], BLOCK=block,
            ROWS=lanes(self.device, 64), num_warps=2,
        )  # fmt: skip
        self._nodes_back(offset, SUM=False, PUSH=False, FINISH=True)

    def _nodes_back(self, offset: int, **stages: bool) -> None:
        block = lanes(self.device, 64, 1)
        launch(nodes_adjoint, (triton.cdiv(self.nodes, block),))(
            self.active, self.source, len(self.source), self.inverse_mass, self.rates, self.pinned, self.nodes,
            self.partial,
            self.fields, self.force_bar, self.history, self.bars, self.mass_bar,
            self.schedule, self.first_step, offset, self.last, *self.gravity,
            **stages, VELOCITY=self.width == 8, HELD=any(self.bound.on_nodes), MASS=self.flags["MASS"],
            DAMPED=self.damped, WIDTH=self.width, BLOCK=block,
            SOURCES=triton.next_power_of_2(len(self.source)), num_warps=4,
        )  # fmt: skip

    def _particles_back(self, offset: int) -> None:
        options, flags = self.options, self.flags
        per_program = lanes(self.device, max(1, 32 // self.lanes), 1)
        _, ny, nz = self.grid.resolution
        cut = self.pieces > self.cells
        to = self.sums(self.pieces, self.width, "adjoint pieces") if cut else self.partial
        launch(particles_adjoint, (triton.cdiv(self.pieces, per_program),))(
            self.fraction, self.material, self.normals, self.law, self.law_table, self.values, self.count,
            self.piece_start, self.piece_node, self.piece_scene, self.pieces, self.piece_nodes,
            self.fields, self.force_bar, to, self.material_bar, self.shares,
            self.loads.rows, self.scenes, self.loads.buffer, self.first_step, offset, self.last,
            ny * nz, nz, 1 / self.grid.dx, self.settings.stiffness_damping,
            LAWS=self.laws, MULTI=options["MULTI"], FORCES=options["FORCES"], VISCOUS=options["VISCOUS"],
            MATERIAL=flags["MATERIAL"], SHARES=flags["SHARES"], WIDTH=self.width, CELLS=per_program, LANES=self.lanes,
            VIRTUAL=self.virtual, SHEETS=self.bent > 0, ADJOINTS=self.adjoints, num_warps=1,
            **({"maxnreg": REGISTERS} if self.lanes == 64 else {}),
        )  # fmt: skip
        if cut:
            self.join_pieces(to, self.partial, self.width)
        if self.bent:
            self._bend(self.force_bar, self.partial, self.width)  # its matrix is symmetric
            if flags["BENDING"]:
                launch(bend_adjoint, (self.bent, 27))(
                    self.bent_node, self.fields, self.force_bar, self.stiffness_bar, num_warps=1
                )

    def _shared(self, count: int) -> tuple[Tensor, Tensor]:
        """Gradients by the vectors of a segment (count, scenes, 3) and by the numbers (3,), summed over particles."""
        rows = self.shares[:count]
        if self.scenes == 1:
            total = rows.sum(1, keepdim=True, dtype=torch.float64)
        else:  # pieces are sorted by scene
            scenes = torch.arange(self.scenes + 1, dtype=torch.int32, device=self.device)
            border = torch.searchsorted(self.piece_scene, scenes)
            total = torch.nn.functional.pad(rows.cumsum(1, dtype=torch.float64), (0, 0, 1, 0))
            total = total[:, border[1:]] - total[:, border[:-1]]
        return total[..., :3], total[..., 4:7].sum((0, 1))


@dataclass
class _Run:
    """Data of one rollout that its backward pass needs.

    Attributes:
        state: The state at its start, and then that at its end, without gradient.
        dt: Substep [s].
        every: Substeps of a segment.
        forces: The force, if any.
        starts: Displacement and velocity of the active nodes at the start of each segment, shape (nodes, 2, 3).
        kicks: Time for which forces act in the first substep of each segment [s].
    """

    kernels: TotalAdjoint
    state: MPMState
    dt: float
    steps: int
    every: int
    forces: tuple[Force, ...]
    watch: Callable[[int], None] | None
    starts: list[Tensor] = field(default_factory=list)
    kicks: list[float] = field(default_factory=list)


_INPUTS = (
    "displacement",
    "velocity",
    "mu",
    "lam",
    "volume",
    "inverse_mass",
    "weight",
    "stiffness",
    "vectors",
    "numbers",
)


class _Rollout(torch.autograd.Function):
    """Nodal fields after a rollout, from those before it and from what it depends on."""

    @staticmethod
    def forward(ctx: Any, run: _Run, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        ctx.run = run
        ctx.given = [None if value is None else value.detach() for value in inputs[-2:]]
        return run.kernels.forward(run)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        needs = dict(zip(_INPUTS, ctx.needs_input_grad[1:], strict=True))
        with at_home(ctx.run.kernels.bars):
            found = ctx.run.kernels.backward(ctx.run, bars, *ctx.given, needs)
        return None, *(found.get(name) if needs[name] else None for name in _INPUTS)


def segment(steps: int, checkpoint: int, nodes: int) -> int:
    """Substeps of a segment: as requested, else about the square root of all, or more if they fit in 128 MiB.

    It is a multiple of what a graph repeats.
    """
    if checkpoint > 0:
        return min(checkpoint, MAX_STEPS, steps)
    fitting = min(2**22 // nodes, MAX_STEPS)  # 32 bytes for each node and substep
    return min(16 * max(1, round(steps**0.5 / 16), fitting // 16), MAX_STEPS, steps)


def _own(tensor: Tensor, nodal: tuple[Tensor | None, ...]) -> bool:
    return tensor.requires_grad and tensor.is_leaf and not any(tensor is t for t in nodal)
