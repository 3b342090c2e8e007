r"""Kirchhoff and Love's shell, and a ring of it that hangs from its inner edge, solved on its own, without MPM.

Places are cubic B-splines of the radius and the angle, so that curvatures are continuous (Kiendl et al. 2009,
"Isogeometric shell analysis with Kirchhoff-Love elements", Computer Methods in Applied Mechanics and Engineering 198).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scipy.interpolate import BSpline
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import eigsh, splu
from torch import Tensor

GRAVITY = 9.81  # m/s²


class Sheet(Protocol):
    """What a sheet is made of: mass to a unit of area [kg/m²], E h [N/m], bending stiffness D [N m], and nu."""

    @property
    def mass(self) -> float:
        """Mass to a unit of area [kg/m²]."""

    @property
    def stretch(self) -> float:
        """E h [N/m]."""

    @property
    def bending(self) -> float:
        """Bending stiffness D [N m]."""

    @property
    def nu(self) -> float:
        """Poisson's ratio."""


@dataclass(frozen=True)
class Ring:
    """A flat ring at rest, clamped at its inner edge, with weight along -z.

    Attributes:
        inner: Radius of the clamped edge [m].
        outer: Radius of the free edge [m].
        mass: Mass to a unit of area [kg/m²].
        stretch: E h [N/m].
        bending: Bending stiffness D [N m].
        nu: Poisson's ratio.
    """

    inner: float
    outer: float
    mass: float
    stretch: float
    bending: float
    nu: float = 0.3


@dataclass(frozen=True)
class Drape:
    """A ring at rest under its weight.

    Attributes:
        edge: Places along the free edge of a half fold, from its ridge to its valley [m], shape (count, 3).
        energy: Of the whole ring, from its flat state [J].
        residual: Largest force on a control point over the weight of the ring.
        steps: Steps of Newton's method.
    """

    edge: np.ndarray
    energy: float
    residual: float
    steps: int


def density(g: Tensor, r: Tensor, sheet: Sheet) -> Tensor:
    r"""Elastic energy to a unit of area at rest [J/m²].

    With Green's strain and the change of the second fundamental form in the basis of the ring at rest, both as

    .. math:: \tfrac12 S \left[(A_{rr} + A_{tt})^2 - 2 (1 - \nu) (A_{rr} A_{tt} - A_{rt}^2)\right],

    S is :math:`E h / (1 - \nu^2)` for the strain and D for the curvature.

    Args:
        g: Derivatives of the place to r, t, rr, rt and tt, with the angle t, shape (15,).
        r: Radius at rest [m]; 1 for Cartesian coordinates.
        sheet: The sheet.
    """
    x_r, x_t, x_rr, x_rt, x_tt = g.reshape(5, 3)
    normal = torch.linalg.cross(x_r, x_t)
    normal = normal / normal.norm()

    def form(rr: Tensor, rt: Tensor, tt: Tensor) -> Tensor:
        return 0.5 * ((rr + tt).square() - 2 * (1 - sheet.nu) * (rr * tt - rt.square()))

    strain = form(0.5 * (x_r.dot(x_r) - 1), 0.5 * x_r.dot(x_t) / r, 0.5 * (x_t.dot(x_t) / r**2 - 1))
    bend = form(normal.dot(x_rr), normal.dot(x_rt) / r, normal.dot(x_tt) / r**2)
    return sheet.stretch / (1 - sheet.nu**2) * strain + sheet.bending * bend


class _Mesh:
    """Cubic splines on one half of a fold, the angle from 0 to pi / folds, between two planes of symmetry."""

    def __init__(self, ring: Ring, folds: int, cells: Sequence[int]) -> None:
        rows, columns = cells
        self.shape = rows + 3, columns + 3
        span = ring.outer - ring.inner
        knots = ring.inner + span * np.clip(np.arange(-3, rows + 4) / rows, 0, 1)
        step = math.pi / folds / columns
        turns = step * np.arange(-3, columns + 4)
        points, weights = np.polynomial.legendre.leggauss(3)
        radii = ring.inner + span / rows * (np.arange(rows)[:, None] + 0.5 + 0.5 * points).ravel()
        angles = step * (np.arange(columns)[:, None] + 0.5 + 0.5 * points).ravel()
        along, around = (splines(knots, radii, rows), splines(turns, angles, columns))
        pairs = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
        self.values = np.stack([np.einsum("ai,bj->abij", along[a], around[b]) for a, b in pairs])
        first = np.repeat(np.arange(rows), 3), np.repeat(np.arange(columns), 3)
        number = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        reach = np.arange(4)
        row, column = first[0][:, None] + reach, first[1][:, None] + reach
        self.index = number[row[:, None, :, None], column[None, :, None, :]]
        self.values = self.values.reshape(6, -1, 16)
        self.index = self.index.reshape(-1, 16)
        self.r = np.repeat(radii, len(angles))
        size = span / rows * step / 4
        self.weight = size * self.r * np.outer(np.tile(weights, rows), np.tile(weights, columns)).ravel()
        # the splines at the start: the ring at rest, from the knots' means along r and a circle around
        mean = np.array([knots[k + 1 : k + 4].mean() for k in range(rows + 3)])
        ways = step * np.arange(-1, columns + 2)
        swell = 3 / (2 + math.cos(step))
        self.rest = np.stack([swell * mean[:, None] * np.cos(ways), swell * mean[:, None] * np.sin(ways),
                              0 * mean[:, None] * ways], axis=-1)  # fmt: skip
        self.share, self.ways = (mean - ring.inner) / span, ways
        self.free = self._free(folds)
        self.edge = splines(turns, step * np.linspace(0, columns, 8 * columns + 1), columns)[0]
        place = np.minimum(np.linspace(0, columns, 8 * columns + 1).astype(int), columns - 1)
        self.edge_index = place[:, None] + reach

    def _free(self, folds: int) -> csc_matrix:
        """From what is unknown to all components of the control points; the first two rows are held."""
        rows, columns = self.shape
        turn = math.pi / folds
        plane = np.array([math.cos(turn), math.sin(turn), 0.0])
        mirror = 2 * np.outer(plane, plane) - np.eye(3)
        mirror[2, 2] = 1
        row, column, value, count = [], [], [], 0

        def put(i: int, j: int, k: int, ways: np.ndarray) -> None:
            for axis in np.flatnonzero(ways):
                row.append(3 * (i * columns + j) + axis)
                column.append(k)
                value.append(ways[axis])

        up = np.array([0.0, 0.0, 1.0])
        for i in range(2, rows):
            for j in range(1, columns - 1):
                ways = {1: [np.array([1.0, 0, 0]), up], columns - 2: [plane, up]}.get(j, list(np.eye(3)))
                for way in ways:
                    put(i, j, count, way)
                    if j == 2:
                        put(i, 0, count, way * [1, -1, 1])
                    if j == columns - 3:
                        put(i, columns - 1, count, mirror @ way)
                    count += 1
        return csc_matrix((value, (row, column)), shape=(3 * rows * columns, count))


def splines(knots: np.ndarray, at: np.ndarray, cells: int) -> np.ndarray:
    """The four cubic splines that are not zero at each place, and their first two derivatives: shape (3, N, 4)."""
    place = np.clip(np.searchsorted(knots, at, side="right") - 4, 0, cells - 1)
    every = BSpline(knots, np.eye(cells + 3), 3)
    reach = place[:, None] + np.arange(4)
    return np.stack([np.take_along_axis(every(at, order), reach, axis=1) for order in range(3)])


def hang(ring: Ring, folds: int = 4, cells: Sequence[int] = (16, 16), seed: float = 0.3, steps: int = 400) -> Drape:
    """Let a ring come to rest under its weight, in a state of given folds that are alike and symmetric.

    Args:
        ring: The ring.
        folds: Number of folds.
        cells: Spline cells along the radius and around a half fold.
        seed: Height of the folds at the free edge at the start, as a share of the width; 0 for none.
        steps: Most steps.
    """
    mesh, width = _Mesh(ring, folds, cells), ring.outer - ring.inner
    place = mesh.rest.copy()
    place[..., 2] = width * mesh.share[:, None] ** 2 * seed * np.cos(folds * mesh.ways)
    place[:2, :, 2] = 0
    total = ring.mass * GRAVITY * math.pi * (ring.outer**2 - ring.inner**2) / (2 * folds)
    rate = (20.0 / width * math.sqrt(width * GRAVITY)) ** 2
    rest = settle(mesh, ring, place, GRAVITY, rate, 1e-7 * total, steps)
    at = rest.place[-1]
    edge = np.einsum("ek,eki->ei", mesh.edge, at[mesh.edge_index])
    return Drape(edge, rest.energy * 2 * folds, rest.force / total, rest.steps)


class Mesh(Protocol):
    r"""Splines of a sheet, the places of its control points at rest, and which of them may move.

    Attributes:
        shape: Number of control points along both directions.
        values: The splines at each point of the quadrature, and their derivatives to r, t, rr, rt and tt, shape
            (6, Q, 16).
        index: The control points that they belong to, shape (Q, 16).
        r: Radius at rest, 1 in Cartesian coordinates, shape (Q,).
        weight: Area of each point of the quadrature [m²], shape (Q,).
        rest: Control points at rest, or where they are held [m], shape (\*shape, 3).
        free: From what is unknown to all components of the control points.
    """

    shape: tuple[int, int]
    values: np.ndarray
    index: np.ndarray
    r: np.ndarray
    weight: np.ndarray
    rest: np.ndarray
    free: csc_matrix


@dataclass(frozen=True)
class Rest:
    r"""A sheet at rest.

    Attributes:
        place: Control points [m], shape (\*shape, 3).
        energy: Elastic energy and that of the weight [J].
        force: Largest force on a control point [N].
        steps: Steps of Newton's method.
    """

    place: np.ndarray
    energy: float
    force: float
    steps: int


def settle(
    mesh: Mesh,
    sheet: Sheet,
    place: np.ndarray,
    gravity: float,
    rate: float,
    enough: float,
    steps: int,
    nudge: float = 0.0,
) -> Rest:
    """Let a sheet come to rest by Newton's method with a mass that gets smaller as the energy falls.

    That is as in backward Euler steps that get longer.

    Args:
        mesh: Its splines.
        sheet: The sheet.
        place: Control points at the start [m].
        gravity: Acceleration along -z [m/s²].
        rate: Inverse of the square of the first step of time [1/s²].
        enough: Force on a control point at which it rests [N].
        steps: Most steps.
        nudge: How far it is moved along its unstable mode where it rests but is not stable [m]; 0 for never.
    """
    first, free, every = rate, mesh.free, mesh.rest.reshape(-1)
    shift = free.T @ (place.reshape(-1) - every) / np.asarray(free.multiply(free).sum(0)).ravel()
    r, weight, index = torch.tensor(mesh.r), mesh.weight, mesh.index
    inner = torch.tensor(mesh.values[1:].transpose(1, 0, 2).copy())
    load = np.zeros((len(every) // 3, 3))
    np.add.at(load[:, 2], index, sheet.mass * gravity * weight[:, None] * mesh.values[0])
    load = load.reshape(-1)
    local = np.einsum("q,qa,qb->qab", sheet.mass * weight, mesh.values[0], mesh.values[0])
    pairs = np.repeat(index, 16, 1).ravel(), np.tile(index, (1, 16)).ravel()
    size = len(every)
    mass = sum(coo_matrix((local.ravel(), (3 * pairs[0] + k, 3 * pairs[1] + k)), (size, size)) for k in range(3))
    mass = (free.T @ mass.tocsc() @ free).tocsc()
    dofs = (3 * index[:, :, None] + np.arange(3)).reshape(-1, 48)
    both = np.repeat(dofs, 48, 1).ravel(), np.tile(dofs, (1, 48)).ravel()

    def one(g: Tensor, radius: Tensor) -> Tensor:
        return density(g, radius, sheet)

    slope = torch.func.vmap(torch.func.grad_and_value(one))
    curve = torch.func.vmap(torch.func.hessian(one))

    def local_at(q: np.ndarray) -> Tensor:
        at = torch.tensor((every + free @ q).reshape(-1, 3)[index])
        return torch.einsum("qka,qai->qki", inner, at).reshape(-1, 15)

    def energy(q: np.ndarray) -> tuple[float, np.ndarray]:
        first, value = slope(local_at(q), r)
        force = torch.einsum("qka,qki->qai", inner, first.reshape(-1, 5, 3)).numpy() * weight[:, None, None]
        total = np.zeros(size)
        np.add.at(total, dofs, force.reshape(-1, 48))
        return float(value.numpy() @ weight + load @ (free @ q)), free.T @ (total + load)

    def stiffness(q: np.ndarray) -> csc_matrix:
        second = curve(local_at(q), r).reshape(-1, 5, 3, 5, 3) * torch.tensor(weight)[:, None, None, None, None]
        half = torch.einsum("qkimj,qka->qaimj", second, inner)
        full = torch.einsum("qaimj,qmb->qaibj", half, inner).reshape(-1).numpy()
        return (free.T @ coo_matrix((full, both), (size, size)).tocsc() @ free).tocsc()

    taken, (now, force) = 0, energy(shift)
    for taken in range(1, steps + 1):  # noqa: B007
        matrix = stiffness(shift)
        while True:
            step = splu(matrix + rate * mass).solve(-force)
            after, pull = energy(shift + step)
            if after <= now + 1e-15 or rate > 1e16:
                break
            rate *= 4
        shift, now, force = shift + step, after, pull
        rate *= 0.3
        if np.abs(force).max() < enough:
            if not nudge:
                break
            square, way = (part[..., 0] for part in eigsh(stiffness(shift), 1, mass, -first))
            if square > 0:
                break
            shift = shift + nudge * way / np.abs(way).max()
            rate, (now, force) = -2 * square, energy(shift)
    return Rest((every + free @ shift).reshape(*mesh.shape, 3), now, float(np.abs(force).max()), taken)
