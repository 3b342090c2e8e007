r"""A tree of wood and leaves: how it sways, and how its leaves damp it.

The wood is a stem with branches, all of them tapered rods thinner than a cell. The leaves are masses and areas on the
branches, which follow the wood: they do not flutter, fold or shelter each other. The reference of the frequency is a
frame of Euler and Bernoulli's beams (:func:`frame_modes`) with the same masses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from bench.problems.beams import first_zero
from bench.problems.rods import section
from bench.problems.settings import Result, Settings, fit_sinusoid, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.wind.field import FlowKey, WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

WOOD_E, WOOD_DENSITY = 8e9, 900.0  # Pa, kg/m³; green wood
AIR, C_D = 1.225, 1.2  # kg/m³; of a flat plate across the flow
LEAF_MASS = 0.2
"""Fresh mass of leaves to a unit of one side's area [kg/m²]."""
AROUND, PER_CELL, HELD = 8, 4, 2


@dataclass(frozen=True)
class Piece:
    """A straight tapered rod of wood.

    Attributes:
        start: Its thick end [m].
        end: Its thin end [m].
        diameter: Diameters there [m].
        leaves: Area of leaves to a unit of length on the outer two thirds [m].
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    diameter: tuple[float, float]
    leaves: float = 0.0

    @property
    def length(self) -> float:
        """Length [m]."""
        return math.dist(self.start, self.end)

    def at(self, share: float) -> tuple[np.ndarray, float, float]:
        """Place [m], diameter [m] and leaves to a unit of length [m] at a share of its length."""
        place = np.array(self.start) + share * (np.array(self.end) - np.array(self.start))
        thick = self.diameter[0] + share * (self.diameter[1] - self.diameter[0])
        return place, thick, self.leaves if share > 1 / 3 else 0.0


def tree(leaf_area: float = 0.0, height: float = 17.3, branches: int = 16) -> list[Piece]:
    """A stem with branches in a spiral, in the golden angle from each to the next.

    Units: ``leaf_area`` [m²]; ``height`` [m].
    """
    stem = Piece((0.0, 0.0, 0.0), (0.0, 0.0, height), (0.17, 0.05))
    found = []
    for number in range(branches):
        share = number / max(branches - 1, 1)
        low, turn, lean = height * (0.45 + 0.5 * share), 2.39996 * number, math.radians(50.0)
        length = height * (0.2 - 0.1 * share)
        way = (math.sin(lean) * math.cos(turn), math.sin(lean) * math.sin(turn), math.cos(lean))
        end = tuple(a + length * b for a, b in zip((0.0, 0.0, low), way, strict=True))
        thick = 0.055 - 0.02 * share
        found.append(Piece((0.0, 0.0, low), end, (thick, 0.4 * thick)))  # type: ignore[arg-type]
    outer = sum(piece.length for piece in found) * 2 / 3
    return [stem, *(Piece(p.start, p.end, p.diameter, leaf_area / outer) for p in found)]


def frame_modes(pieces: Sequence[Piece], parts: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies and modes of a clamped frame of Euler and Bernoulli's beams.

    Each piece is cut into equal elements with the mean section of each, and masses lumped at their ends. A piece that
    is not the first begins at the nearest node of the first, from which a rigid arm leads to its start.

    Returns:
        Circular frequencies [1/s] in ascending order, their modes (node, six motions) and the places of the nodes [m].
    """
    from scipy.linalg import eigh

    places: list[np.ndarray] = []
    ends: list[tuple[int, Piece, float, float]] = []
    joined: list[tuple[int, int]] = []
    for number, piece in enumerate(pieces):
        count = parts * 4 if number == 0 else parts
        first = len(places)
        places += [piece.at(k / count)[0] for k in range(count + 1)]
        ends += [(first + k, piece, k / count, (k + 1) / count) for k in range(count)]
        if number:
            stem = np.array(places[: parts * 4 + 1])
            joined.append((first, int(np.linalg.norm(stem - places[first], axis=1).argmin())))
    size = 6 * len(places)
    stiff, mass = np.zeros((size, size)), np.zeros(size)
    for node, piece, low, high in ends:
        length = piece.length * (high - low)
        _, thick, leaves = piece.at(0.5 * (low + high))
        area, moment = math.pi * thick**2 / 4, math.pi * thick**4 / 64
        axis = (places[node + 1] - places[node]) / length
        side = np.eye(3)[np.abs(axis).argmin()]
        second = np.cross(axis, side) / np.linalg.norm(np.cross(axis, side))
        turn = np.kron(np.eye(4), np.stack([axis, second, np.cross(axis, second)]))
        part = slice(6 * node, 6 * node + 12)
        stiff[part, part] += turn.T @ _element(WOOD_E, area, moment, length) @ turn
        each = 0.5 * length * (WOOD_DENSITY * area + LEAF_MASS * leaves)
        for tip in (node, node + 1):
            mass[6 * tip : 6 * tip + 3] += each
            mass[6 * tip + 3 : 6 * tip + 6] += each * length**2 / 12
    reduce = np.eye(size)
    gone = list(range(6))  # the foot
    for base, held in joined:
        arm = places[base] - places[held]
        reduce[6 * base : 6 * base + 6] = 0
        reduce[6 * base : 6 * base + 6, 6 * held : 6 * held + 6] = np.eye(6)
        reduce[6 * base : 6 * base + 3, 6 * held + 3 : 6 * held + 6] = -_cross(arm)
        gone += range(6 * base, 6 * base + 6)
    reduce = np.delete(reduce, gone, axis=1)
    squares, modes = eigh(reduce.T @ stiff @ reduce, reduce.T @ (mass[:, None] * reduce))
    return np.sqrt(squares), (reduce @ modes).T.reshape(len(squares), -1, 6), np.array(places)


def _cross(arm: np.ndarray) -> np.ndarray:
    x, y, z = arm
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _element(young: float, area: float, moment: float, length: float) -> np.ndarray:
    """Stiffness of a round beam along x, shape (12, 12), without Poisson's effect in torsion (G = E / 2)."""
    found = np.zeros((12, 12))
    bend = young * moment / length**3 * np.array([
        [12, 6 * length, -12, 6 * length], [6 * length, 4 * length**2, -6 * length, 2 * length**2],
        [-12, -6 * length, 12, -6 * length], [6 * length, 2 * length**2, -6 * length, 4 * length**2]])  # fmt: skip
    pair = np.array([[1, -1], [-1, 1]])
    found[np.ix_([0, 6], [0, 6])] = young * area / length * pair
    found[np.ix_([3, 9], [3, 9])] = 0.5 * young * 2 * moment / length * pair
    found[np.ix_([1, 5, 7, 11], [1, 5, 7, 11])] = bend
    sign = np.array([1, -1, 1, -1])
    found[np.ix_([2, 4, 8, 10], [2, 4, 8, 10])] = bend * np.outer(sign, sign)
    return found


def _points(
    pieces: Sequence[Piece], dx: float, settings: Settings
) -> tuple[MaterialPoints, torch.Tensor, torch.Tensor]:
    """Points of the wood, rings of :data:`AROUND`, and of the leaves, three at one place; normals and areas of leaves.

    The first piece is an upright stem, which is continued downwards by :data:`HELD` cells.
    """
    place, volume, mass, stiff, normal, area = [], [], [], [], [], []
    for number, piece in enumerate(pieces):
        count = max(2, round(piece.length / dx * PER_CELL))
        step = piece.length / count
        axis = (np.array(piece.end) - np.array(piece.start)) / piece.length
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        turn = np.stack([side / np.linalg.norm(side), np.cross(axis, side / np.linalg.norm(side))])
        for k in range(0 if number else -HELD * PER_CELL, count):
            middle, thick, leaves = piece.at((k + 0.5) / count)
            ring = section(thick, AROUND).numpy() @ turn
            wood = math.pi * thick**2 / 4 * step / AROUND
            place += list(middle + ring)
            volume += [wood] * AROUND
            mass += [WOOD_DENSITY * wood] * AROUND
            stiff += [WOOD_E] * AROUND
            normal += [np.array([1.0, 0.0, 0.0])] * AROUND
            area += [0.0] * AROUND
            if leaves:
                place += [middle] * 3
                volume += [LEAF_MASS * leaves * step / 3 / WOOD_DENSITY] * 3
                mass += [LEAF_MASS * leaves * step / 3] * 3
                stiff += [1e-6 * WOOD_E] * 3
                normal += list(np.eye(3))
                area += [leaves * step / 3] * 3
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    each = [torch.tensor(np.array(values)).to(like) for values in (place, volume, mass, stiff, normal, area)]
    points = MaterialPoints.create(
        each[0], volume=each[1], density=each[2] / each[1], youngs_modulus=each[3], poisson_ratio=0.0
    )
    return points, each[4], each[5]


@dataclass(frozen=True)
class Swaying:
    """A tree on a grid with its first mode.

    Attributes:
        force: The air on its leaves.
        omega: Circular frequency of the frame's first mode [1/s].
        shape: Motion of the points in that mode, 1 at the top of the stem along x, shape (P, 3).
        share: Of the wood in the mass that moves in the mode.
    """

    points: MaterialPoints
    force: WindForce
    omega: float
    shape: torch.Tensor
    share: float


def swaying(pieces: Sequence[Piece], dx: float, settings: Settings, wind: WindField | None = None) -> Swaying:
    """The points of a tree, and the mode of its frame at their places, in a wind."""
    from scipy.spatial import cKDTree

    omegas, modes, nodes = frame_modes(pieces)
    top = np.abs(nodes - np.array(pieces[0].end)).sum(1).argmin()
    first = modes[0] * modes[0][top, 0] + modes[1] * modes[1][top, 0]  # of the two that are nearly equal, along x
    first /= first[top, 0]
    points, normal, area = _points(pieces, dx, settings)
    where = points.position.double().cpu().numpy()
    near = cKDTree(nodes).query(where)[1]
    arm = where - nodes[near]
    shape = torch.tensor(first[near, :3] + np.cross(first[near, 3:], arm)).to(points.position)
    shape[points.position[:, 2] <= 0] = 0
    moving = points.mass * shape.square().sum(-1)
    wood = points.youngs_modulus == WOOD_E
    force = WindForce(
        AeroForce(C_D=C_D, C_F=0.0, C_L=0.0, air_density=AIR, law="projected"), wind or WindField(), normal, area
    )
    share = float(moving[wood].sum() / moving.sum())
    return Swaying(points, force.to(points.position.device), float(omegas[0]), shape, share)


FOOT = Box([None] * 3, [None, None, 0.0])


def frequency(leaf_area: float = 0.0, dx: float = 0.5, settings: Settings | None = None, **shape: float) -> Result:
    """The lowest frequency of a tree, from the quarter of a period after which its mode stands still.

    Units: ``leaf_area`` [m²]; ``dx`` [m].

    Returns:
        ``error`` (of the frequency, relative to the frame), ``hertz``, ``exact``, ``wood`` and ``leaves`` (masses [kg])
        and the common quantities.
    """
    settings = Settings() if settings is None else settings
    one = swaying(tree(leaf_area, **shape), dx, settings)  # type: ignore[arg-type]
    solver = settings.solver(dx, boundaries=[PinnedRegion(FOOT, "clamp")])
    weight = one.points.mass[:, None] * one.shape
    start = solver.init_state(one.points, 1e-3 * one.omega * one.shape)
    run = follow(solver, start, 2.4 / one.omega / 40, 40, lambda state: (weight * state.velocity).sum())
    crossing = first_zero(run.time, run.series.reshape(-1))
    found = 0.0 if crossing is None else math.pi / 2 / crossing
    grown = one.points.position[:, 2] > 0
    wood = one.points.youngs_modulus == WOOD_E
    masses = {name: float(one.points.mass[mask & grown].sum()) for name, mask in (("wood", wood), ("leaves", ~wood))}
    hertz, exact = found / 2 / math.pi, one.omega / 2 / math.pi
    return run.result(hertz / exact - 1, hertz=hertz, exact=exact, **masses)


def damping(
    leaf_area: float,
    pull: float = 0.5,
    breeze: float = 0.0,
    wood: float = 0.051,
    dx: float = 0.5,
    settings: Settings | None = None,
    periods: float = 3.0,
    **shape: float,
) -> Result:
    r"""Let a tree sway in its first mode, and fit a damped sinusoid to its speed.

    The wood damps itself with the same force in both trees: as a rate over all masses, :math:`2 \zeta \omega`
    without leaves, and that times the share of the wood in the mass of the mode with them. The drag of a leaf grows
    with the square of the speed of the air against it, so the damping depends on the pull and on the breeze. The
    reference is the equation of the mode alone (:func:`mode_motion`), fitted in the same way.

    Units: ``leaf_area`` [m²]; ``pull``, ``dx`` [m]; ``breeze`` [m/s].

    Returns:
        ``ratio`` (damping ratio), ``exact`` (that of the equation of the mode), ``error`` (relative to it), ``hertz``
        and the common quantities.
    """
    settings, air = settings or Settings(), np.array([breeze, 0.0, 0.0])
    one = swaying(tree(leaf_area, **shape), dx, settings, WindField(air.tolist()))  # type: ignore[arg-type]
    bare = one if leaf_area == 0 else swaying(tree(0.0, **shape), dx, settings)  # type: ignore[arg-type]
    rate = 2 * wood * bare.omega * one.share
    solver = settings.solver(dx, boundaries=[PinnedRegion(FOOT, "clamp")], damping=rate)
    start = solver.init_state(one.points, pull * one.omega * one.shape)
    weight = one.points.mass[:, None] * one.shape
    total = float((weight * one.shape).sum())

    def speed(state: MPMState) -> torch.Tensor:
        return (weight * state.velocity).sum() / total

    frames, frame = round(32 * periods), 2 * math.pi / one.omega / 32
    run = follow(solver, start, frame, frames, speed, one.force if leaf_area else None)
    omega, ratio = _fitted(run.time, run.series.reshape(-1))
    speeds = mode_motion(one, rate, pull * one.omega, lambda time: air, frame, frames)[:, 1]
    _, exact = _fitted(run.time, torch.from_numpy(speeds))
    return run.result(ratio / exact - 1, ratio=ratio, exact=exact, hertz=omega / 2 / math.pi)


def _fitted(time: torch.Tensor, speed: torch.Tensor) -> tuple[float, float]:
    omega, decay = fit_sinusoid(time, speed)
    return omega, decay / math.hypot(omega, decay)


def in_gusts(
    flows: np.ndarray, rate: float, leaf_area: float, wood: float = 0.051, dx: float = 1.0, **shape: float
) -> dict[str, np.ndarray]:
    r"""Let a measured wind, the same everywhere, sway a tree from rest.

    The transfer function of the mode, for small fluctuations about the mean wind, with the push p(u, v) of the air:

    .. math:: H = \frac{\partial p / \partial u}{\omega_1^2 - \omega^2 + i \omega (r - \partial p / \partial v)}

    Units: ``flows`` [m/s], shape (T, 3), the mean along x, at a ``rate`` [Hz]; ``leaf_area`` [m²]; ``dx`` [m].

    Returns:
        Displacement of the first mode at the top [m] at the times of the wind, shape (T,): ``found`` by the solver,
        ``mode`` by the equation of the mode, ``linear`` by its transfer function, and ``own`` as ``mode`` with the
        frequency that the tree has on this grid.
    """
    settings, frame, frames = Settings(dtype=torch.float32), 1 / rate, len(flows) - 1
    keys = [FlowKey(frame * k, flow.tolist()) for k, flow in enumerate(flows)]
    wind = WindField(schedule=keys, interpolation="linear")
    one = swaying(tree(leaf_area, **shape), dx, settings, wind)  # type: ignore[arg-type]
    damping = 2 * wood * one.omega * one.share
    solver = settings.solver(dx, boundaries=[PinnedRegion(FOOT, "clamp")], damping=damping)
    weight = one.points.mass[:, None] * one.shape
    total, rest = (weight * one.shape).sum(), one.points.position

    def moved(state: MPMState) -> torch.Tensor:
        return (weight * (state.position - rest)).sum() / total

    run = follow(solver, solver.init_state(one.points), frame, frames, moved, one.force)
    air = make_interp_spline(frame * np.arange(len(flows)), flows, 1)
    push, mean, small = push_of(one), flows.mean(0), 1e-3
    more = np.array([small, 0.0, 0.0])
    du = (push(mean + more, 0.0) - push(mean - more, 0.0)) / (2 * small)
    dv = (push(mean, small) - push(mean, -small)) / (2 * small)
    circular = 2 * math.pi * np.fft.rfftfreq(2 * len(flows), frame)
    transfer = du / (one.omega**2 - circular**2 + 1j * circular * (damping - dv))
    driven = np.fft.irfft(transfer * np.fft.rfft(flows[:, 0] - mean[0], 2 * len(flows)))[: len(flows)]
    own = replace(one, omega=2 * math.pi * frequency(leaf_area, dx, settings, **shape)["hertz"])
    return {
        "found": run.series.reshape(-1).numpy(),
        "mode": mode_motion(one, damping, 0.0, air, frame, frames)[:, 0],
        "linear": driven + push(mean, 0.0) / one.omega**2,
        "own": mode_motion(own, damping, 0.0, air, frame, frames)[:, 0],
    }


def push_of(one: Swaying) -> Callable[[np.ndarray, float], float]:
    r"""The acceleration of the first mode by an air at a speed of its top [m/s²], from both speeds [m/s].

    .. math:: p(\mathbf{u}, v) = \frac{1}{M} \sum_i \tfrac12 \rho C_D A_i |\mathbf{v}_i| (\mathbf{v}_i \mathbf{n}_i)
        (\mathbf{n}_i \phi_i), \qquad \mathbf{v}_i = \mathbf{u} - v \phi_i
    """
    leaf = one.force.area > 0
    shape, normal, area = (each[leaf].double().numpy() for each in (one.shape, one.force.normal, one.force.area))
    mass = float((one.points.mass[:, None] * one.shape.square()).sum())
    weight = 0.5 * AIR * C_D * area * (normal * shape).sum(-1) / mass

    def push(air: np.ndarray, speed: float) -> float:
        against = air - speed * shape
        return float(weight @ (np.linalg.norm(against, axis=1) * (against * normal).sum(-1)))

    return push


def mode_motion(
    one: Swaying, rate: float, start: float, air: Callable[[float], np.ndarray], frame: float, frames: int
) -> np.ndarray:
    r"""The top of a tree that moves in its first mode alone, from rest at a speed.

    .. math:: \ddot q + r \dot q + \omega^2 q = p(\mathbf{u}, \dot q)

    Units: ``start``, and ``air`` at a time [m/s]; ``frame`` [s].

    Returns:
        Displacements [m] and speeds [m/s], shape (frames + 1, 2).
    """
    push, times = push_of(one), frame * np.arange(frames + 1)

    def change(time: float, now: np.ndarray) -> list[float]:
        return [now[1], push(air(time), now[1]) - rate * now[1] - one.omega**2 * now[0]]

    return solve_ivp(change, times[[0, -1]], [0.0, start], t_eval=times, rtol=1e-7, atol=1e-9, max_step=frame).y.T
