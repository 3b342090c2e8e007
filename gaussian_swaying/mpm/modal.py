r"""Modes of a body about its rest, by linear algebra: stiffness, mass, Ritz vectors and the first frequency.

The stiffness matrix of the ``total`` formulation at rest is constant, so a few sparse solves tell how a body sways.

- **Stiffness.** :math:`K = \sum_p V_p\, B_p^T C_p B_p` over the gradients of the stencils, with Hooke's law, which all
  laws share at small strain; :math:`M` is the lumped mass of the nodes. Pinned nodes go, pinned points are stiff rows,
  and a rigid part has six degrees of freedom.
- **Shift.** Captures have bits that hang on a corner of a cell; the lowest eigenvectors are theirs. :math:`K + s M`
  with :math:`s = (\omega_1 / 2)^2` tames them, where :math:`\omega_1` is the first frequency that is found with the
  shift itself, starting from a stiff guess.
- **First frequency.** That of the mode on which a level wind does most work, near Rayleigh's quotient of the lean, in
  the softer direction.
- **Modes.** Load-dependent Ritz vectors (Wilson, Yuan & Dickens 1982, Earthq. Eng. Struct. Dyn. 10:813) in place of
  eigenvectors: the answers to loads along three axes, on the whole and on clusters of points, and the answers to their
  inertia. Loose bits are left out: modes below :data:`LOOSE` of the first frequency, and those below the first
  frequency in which less than :data:`BITS` of the mass moves and the wind does less than :data:`IDLE` of its work.

All results are for a body of 1 kg with a mean Young's modulus of 1 Pa, so that they serve for any factor of either.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
import torch

from gaussian_swaying._files import atomic, cache_folder
from gaussian_swaying.geometry.groups import equal_rows

if TYPE_CHECKING:
    from gaussian_swaying.mpm.total import Total

SHIFT = 0.5
"""Frequency of the shift over the first one."""
LOOSE = 0.6
"""Frequency over the first one below which a mode is a loose bit."""
NEAR = (0.6, 1.5)
"""Frequencies over Rayleigh's quotient of the lean between which the first mode is looked for."""
BITS = 0.03
"""Share of the mass that moves in a mode of a few bits, at most."""
IDLE = 0.01
"""Share of the work of a level wind that it does on a mode of loose bits, at most."""
CLUSTERS = 24
"""Clusters of points that are loaded one by one."""
STIFF_ROW = 1e4
"""Stiffness of a pinned point over the largest entry of the stiffness matrix."""
NO_STIFFNESS = 1e-10
"""Square of the first frequency over that of a wave along the body, below which its stiffness is rounding."""
MOST_UNKNOWNS = 150_000
"""A body with more is refused: its factor would fill the memory."""
KEPT = 32
"""Analyses in the cache."""
_VERSION = 10  # of the analysis, in the name of the file


@dataclass(frozen=True)
class Analysis:
    """The modes of one scene for a mass of 1 kg and a mean Young's modulus of 1 Pa.

    Attributes:
        square: Squares of the circular frequencies [1/s²], ascending, shape (M,).
        node: The nodes that move, shape (N,).
        shape: Their displacement, normalised by the mass [1/sqrt(kg)], shape (3N, M).
        turn: Their rotation [1/(m sqrt(kg))], shape (3N, M).
        site: The site of each point, shape (P,): the points that have the same nodes move as one.
        site_shape: As ``shape``, of the sites, shape (3S, M).
        site_turn: As ``turn``, of the sites, shape (3S, M).
        reaction: Force on each boundary by the amplitudes, shape (B, 3, M).
        direct: Share of the load on a site that each boundary takes directly, shape (B, S).
        first: Square of the first circular frequency [1/s²].
        second: The main mode across the first one.
        dropped: Number of modes that were left out as loose bits.
    """

    square: np.ndarray
    node: np.ndarray
    shape: np.ndarray
    turn: np.ndarray
    site: np.ndarray
    site_shape: np.ndarray
    site_turn: np.ndarray
    reaction: np.ndarray
    direct: np.ndarray
    first: float
    second: int
    dropped: int


class Structure:
    """Stiffness and mass of one scene of a body at rest.

    Args:
        total: The body, bound to its grid.
        scene: Which scene of a batch.

    Attributes:
        mass: Mass of the nodes, of 1 kg in all, shape (G,).
        spread: Displacement of the nodes by that of the degrees of freedom, sparse, shape (3G, n).
        value: Weights of the nodes at the points, sparse, shape (P, G).
        slope: Their derivatives along three axes.
    """

    def __init__(self, total: Total, scene: int = 0) -> None:
        import scipy.sparse as sparse

        points, stencil = total.points, total.stencil
        count, nodes = points.count, total.grid.node_count
        own = slice(scene * count, (scene + 1) * count)

        def of_scene(field: torch.Tensor) -> np.ndarray:
            return field.detach().reshape(-1, count)[scene].double().cpu().numpy()

        self.total, self.scene, self.nodes, self.count = total, scene, nodes, count
        table = stencil.node[own].cpu() - scene * nodes
        basis = stencil.basis[own].double().cpu().numpy()
        self.rest = points.position.detach().reshape(-1, count, 3)[scene].double().cpu().numpy()
        mass, volume = of_scene(points.mass), of_scene(points.volume)
        self.point_mass = mass / mass.sum()
        self.mean_modulus = float((of_scene(points.youngs_modulus) * volume).sum() / volume.sum())
        self.table, self.site = table.numpy(), equal_rows(table).numpy()
        start = np.arange(0, 27 * count + 1, 27)
        rows = [sparse.csr_matrix((basis[:, k].ravel(), self.table.ravel(), start), (count, nodes)) for k in range(4)]
        self.value, self.slope = rows[0], rows[1:]
        self.mass = self.value.T @ self.point_mass
        self.volume, self._basis = volume, basis[:, 1:]
        self._lame = [volume * of_scene(field) / self.mean_modulus for field in (total.laws.mu, total.laws.lam)]
        self.pinned, rows_of = self._pins()
        self.pins = [
            (k, sparse.kron(weight, sparse.identity(3), format="csr"), is_slope) for k, weight, is_slope in rows_of
        ]
        self.loose = self._tie()
        self.spread = self._degrees()

    @cached_property
    def stiffness(self) -> Any:
        """K of the nodes, with pinned points and ties as stiff rows [N/m for a mean modulus of 1 Pa], sparse."""
        return self.with_rows(self.hooke())

    def with_rows(self, K: Any) -> Any:
        self.stiff = STIFF_ROW * float(abs(K.diagonal()).max())
        for _, row, _ in self.pins:
            K = K + self.stiff * (row.T @ row)
        for row in self.loose:
            K = K + self.stiff / STIFF_ROW * (row.T @ row)
        return K.tocsr()

    def reduced(self, K: Any) -> tuple[Any, Any]:
        """Stiffness and mass in the degrees of freedom, from a nodal stiffness."""
        import scipy.sparse as sparse

        S = self.spread
        return (S.T @ K @ S).tocsc(), (S.T @ sparse.diags(np.repeat(self.mass, 3)) @ S).tocsc()

    def hooke(self, some: np.ndarray | None = None) -> Any:
        """The stiffness of Hooke's law, of all points or of some of them, bool (P,), for a mean modulus of 1 Pa."""
        import scipy.sparse as sparse

        mu, lam = self._lame
        slope = self._basis
        order = np.argsort(self.site, kind="stable")
        order = order if some is None else order[some[order]]
        many = np.bincount(self.site[order])
        many = many[many > 0]
        first = np.cumsum(many) - many
        g = slope.transpose(0, 2, 1).reshape(len(slope), 81)  # node by axis
        keys, blocks = [], []
        for begin in range(0, len(many), 1024):
            groups = np.arange(begin, min(begin + 1024, len(many)))
            most = int(many[groups].max())
            place = np.minimum(first[groups][:, None] + np.arange(most), len(order) - 1)
            there = np.arange(most) < many[groups][:, None]
            member = order[place]
            own = g[member] * there[..., None]
            a, b = (np.matmul((w[member][..., None] * own).transpose(0, 2, 1), own) for w in (mu, lam))
            a, b = (x.reshape(-1, 27, 3, 27, 3).transpose(0, 1, 3, 2, 4) for x in (a, b))
            trace = np.trace(a, axis1=-2, axis2=-1)
            block = b + a.swapaxes(-1, -2)
            for k in range(3):
                block[..., k, k] += trace
            node = self.table[order[first[groups]]].astype(np.int64)
            keys.append((node[:, :, None] * self.nodes + node[:, None, :]).ravel())
            blocks.append(block.reshape(-1, 9))
            rank = np.argsort(keys[-1], kind="stable")
            key = keys[-1][rank]
            edge = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
            keys[-1], blocks[-1] = key[edge], np.add.reduceat(blocks[-1][rank], edge, axis=0)
        parts = [
            sparse.bsr_matrix(
                (
                    block.reshape(-1, 3, 3),
                    key % self.nodes,
                    np.searchsorted(key, np.arange(self.nodes + 1) * self.nodes),
                ),
                shape=(3 * self.nodes, 3 * self.nodes),
            ).tocsr()
            for key, block in zip(keys, blocks, strict=True)
        ]
        return sum(parts[1:], parts[0])

    def _pins(self) -> tuple[np.ndarray, list[tuple[int, Any, bool]]]:
        """The boundary that holds each node, -1 for none, shape (G,); and the rows of pinned points."""
        import scipy.sparse as sparse

        total, scene = self.total, self.scene
        pinned = np.full(self.nodes, -1)
        for k, held in enumerate(total.pinned):
            if held is None or not total.on_nodes[k] or k in total.rigid:
                continue
            assert held.share is not None
            share = held.share.reshape(-1, self.nodes)[scene].detach().cpu().numpy()
            pinned[share > held.threshold] = k
        rows = []
        if total.pinned_rows is not None:
            fields = (field[0, scene].detach().cpu().numpy() for field in total.pinned_rows.rows)
            node, weight, _, slope, owner, release = fields
            node = node - scene * self.nodes
            for k in range(len(total.kinds)):
                for is_slope in (False, True):
                    some = np.flatnonzero((owner == k) & (slope == is_slope) & (release > 0))
                    if len(some):
                        w = weight[some] / np.linalg.norm(weight[some], axis=1, keepdims=True)
                        start = np.arange(0, 27 * len(some) + 1, 27)
                        shape = (len(some), self.nodes)
                        rows.append((k, sparse.csr_matrix((w.ravel(), node[some].ravel(), start), shape), is_slope))
        return pinned, rows

    def _tie(self) -> list[Any]:
        import scipy.sparse as sparse
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        reach = sparse.csr_matrix((np.ones(self.table.size), self.value.indices, self.value.indptr), self.value.shape)
        _, label = connected_components(reach.T @ reach, directed=False)
        held = np.unique(label[self.pinned >= 0])
        for _, row, _ in self.pins:
            held = np.union1d(held, label[row.indices // 3])
        piece = label[self.table[:, 0]]
        free = ~np.isin(piece, held)
        if not free.any() or free.all():
            return []
        some = [np.flatnonzero(piece == k)[:: max(1, int((piece == k).sum()) // 8)] for k in np.unique(piece[free])]
        follower = np.concatenate(some)
        hosts = np.flatnonzero(~free)
        tree = cKDTree(self.rest[hosts])
        near = [tree.query(self.rest[own]) for own in some]
        host = np.concatenate([np.full(len(at), hosts[at[away.argmin()]]) for away, at in near])
        arm = self.rest[follower] - self.rest[host]
        axis = [sparse.csr_matrix(([1.0], ([0], [k])), (1, 3)) for k in range(3)]
        rows = []
        for a in range(3):  # u_i - u_j - (curl u_j / 2) x arm
            row = sparse.kron(self.value[follower] - self.value[host], axis[a], format="csr")
            for c in range(3):
                half = sparse.diags(0.5 * arm[:, c])
                row = row - sparse.kron(half @ self.slope[c][host], axis[a], format="csr")
                row = row + sparse.kron(half @ self.slope[a][host], axis[c], format="csr")
            rows.append(row)
        return rows

    def _degrees(self) -> Any:
        import scipy.sparse as sparse

        free = (self.pinned < 0) & (self.mass > 1e-7 * self.mass.max())
        columns = []
        place = self.total.node_positions(self.total.node_mass).reshape(-1, self.nodes, 3)
        where = place[min(self.scene, len(place) - 1)].double().cpu().numpy()
        for body in self.total.rigid_bodies:
            own = np.flatnonzero(body.mass.reshape(-1, self.nodes)[self.scene].cpu().numpy() > 0)
            still = bool((self.pinned[own] >= 0).any())
            free[own] = False
            if still:
                continue
            arm = where[own] - where[own].mean(0)
            block = np.zeros((len(own), 3, 6))
            block[:, [0, 1, 2], [0, 1, 2]] = 1
            for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
                block[:, j, 3 + axis], block[:, i, 3 + axis] = arm[:, i], -arm[:, j]
            rows = (3 * own[:, None] + np.arange(3)).ravel()
            part = sparse.coo_matrix(block.reshape(-1, 6))
            columns.append(sparse.csr_matrix((part.data, (rows[part.row], part.col)), (3 * self.nodes, 6)))
        index = (3 * np.flatnonzero(free)[:, None] + np.arange(3)).ravel()
        ones = sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), (3 * self.nodes, len(index)))
        return sparse.hstack([ones, *columns]).tocsr()

    # ---- what follows from it

    def at_points(self, nodal: np.ndarray) -> np.ndarray:
        """Displacement of the points, shape (P, 3, K), by that of the nodes, shape (3G, K)."""
        return (self.value @ nodal.reshape(self.nodes, -1)).reshape(self.count, 3, -1)

    def turn_at_points(self, nodal: np.ndarray) -> np.ndarray:
        """Rotation of the points, half of the curl, shape (P, 3, K), by the displacement of the nodes (3G, K)."""
        along = [(s @ nodal.reshape(self.nodes, -1)).reshape(self.count, 3, -1) for s in self.slope]
        parts = [along[j][:, k] - along[k][:, j] for j, k in ((1, 2), (2, 0), (0, 1))]
        return 0.5 * np.stack(parts, 1)

    def analyse(self, most: int, guess: float | None = None) -> Analysis:
        """Find the modes.

        Args:
            guess: Square of the first circular frequency, if it is roughly known [1/s²]; it saves time.
        """
        S = self.spread
        if S.shape[1] > MOST_UNKNOWNS:
            raise ValueError(
                f"`solver.formulation: modes` would have {S.shape[1]:,} unknowns (at most {MOST_UNKNOWNS:,}): raise "
                "`solver.dx`, or set it to total."
            )
        if S.shape[1] == 0:
            raise ValueError("All of the body is held, so `solver.formulation: modes` has no modes: hold less of it.")
        K, M = self.reduced(self.stiffness)
        load = self.loads(CLUSTERS)
        whole = S.T @ load[:, :2]
        begin = self._first_guess()
        shift = _power_of_two(begin if guess is None else SHIFT**2 * guess)
        for _ in range(12):
            solve = factor(K + shift * M)
            first = rayleigh(K, M, solve(whole))
            if not first > NO_STIFFNESS * begin:
                raise ValueError(
                    "`solver.formulation: modes` is for a body that stands against the wind, but most of this one "
                    "hangs loose: hold more of it, give it more points in each cell, or set it to total."
                )
            following = _power_of_two(SHIFT**2 * first)
            if following == shift or (following > shift and guess is None):
                break
            shift = following
        blocks = [solve(S.T @ load)]
        blocks.append(solve(M @ np.linalg.qr(blocks[0])[0]))
        square, modes = reduced_modes(K, M, np.concatenate(blocks, 1))
        share = self._mass_share(S @ modes)
        pull = modes.T @ whole
        main = min(_main(square, pull, first, share), key=lambda k: square[k])
        first = square[main]
        moved = pull**2 / square[:, None]
        idle = (moved < IDLE * moved.sum(0)).all(1)  # one that shares the sway with a bit of the same frequency is not
        loose = (square < LOOSE**2 * first) | ((square < first) & (share < BITS) & idle)
        chosen = np.flatnonzero(~loose)[:most]
        across = (pull @ [-pull[main, 1], pull[main, 0]])[chosen] ** 2 / square[chosen]
        second = int(np.where(chosen == main, 0.0, across).argmax())
        return self._result(square[chosen], S @ modes[:, chosen], float(first), second, int(loose.sum()))

    def _first_guess(self) -> float:
        side = float(np.ptp(self.rest, axis=0).max())
        return max(self.volume.sum() / max(side, 1e-30) ** 2, 1e-300)

    def loads(self, clusters: int) -> np.ndarray:
        """Loads on the nodes along three axes: on the whole, and on clusters of points; shape (3G, 3 + 3 clusters)."""
        from scipy.cluster.vq import kmeans2

        count = min(clusters, max(1, self.count // 4))
        label = kmeans2(self.rest, count, seed=0, minit="++")[1] if count else np.zeros(self.count, int)
        share = self.volume / self.volume.sum()
        of = np.concatenate([share[:, None], share[:, None] * (label[:, None] == np.arange(count))], 1)
        nodal = self.value.T @ of
        found = np.zeros((self.nodes, 3, of.shape[1], 3))
        for axis in range(3):
            found[:, axis, :, axis] = nodal
        return found.reshape(3 * self.nodes, -1)

    def _mass_share(self, shape: np.ndarray) -> np.ndarray:
        """Share of the mass that moves in some shapes (3G, M), as if all of it moved alike, shape (M,)."""
        square = (shape.reshape(self.nodes, 3, -1) ** 2).sum(1)
        return (self.mass @ square) ** 2 / np.maximum(self.mass.sum() * (self.mass @ square**2), 1e-300)

    def _result(self, square: np.ndarray, shape: np.ndarray, first: float, second: int, dropped: int) -> Analysis:
        modes, sites = shape.shape[1], int(self.site.max()) + 1
        turn_points = self.turn_at_points(shape)
        weighted = self.value.T @ (self.point_mass[:, None] * turn_points.reshape(self.count, -1))
        turn = weighted / np.maximum(self.mass, 1e-7 * self.mass.max())[:, None]
        own = np.bincount(self.site, self.point_mass, sites)

        def at_sites(field: np.ndarray) -> np.ndarray:
            total = np.zeros((sites, field.shape[1]))
            np.add.at(total, self.site, self.point_mass[:, None] * field)
            return total / own[:, None]

        node = np.flatnonzero(shape.reshape(self.nodes, -1).any(1))
        boundaries = len(self.total.kinds)
        reaction, direct = np.zeros((boundaries, 3, modes)), np.zeros((boundaries, sites))
        forces = (self.stiffness @ shape).reshape(self.nodes, 3, modes)
        taken = at_sites(self.value @ (self.pinned[:, None] == np.arange(boundaries)).astype(float))
        for k in range(boundaries):
            reaction[k] = -forces[self.pinned == k].sum(0)
            direct[k] = taken[:, k]
        for k, row, is_slope in self.pins:
            if not is_slope:
                pull = self.stiff * (row @ shape).reshape(-1, 3, modes)
                size = row[::3].sum(1)  # a row is divided by its norm
                reaction[k] += (np.asarray(size)[:, :, None] * pull).sum(0)
        return Analysis(
            square=square,
            node=node,
            shape=shape.reshape(self.nodes, -1)[node].reshape(-1, modes),
            turn=turn[node].reshape(-1, modes),
            site=self.site,
            site_shape=at_sites(self.at_points(shape).reshape(self.count, -1)).reshape(3 * sites, modes),
            site_turn=at_sites(turn_points.reshape(self.count, -1)).reshape(3 * sites, modes),
            reaction=reaction,
            direct=direct,
            first=first,
            second=second,
            dropped=dropped,
        )


def reduced_modes(K: Any, M: Any, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modes within the span of some vectors (n, k): squares of frequencies, ascending, and shapes of unit mass."""
    import scipy.linalg as linalg

    R = vectors
    for _ in range(2):  # the second time it is exact
        R = R / np.maximum(np.sqrt((R * (M @ R)).sum(0)), 1e-300)
        size, axes = np.linalg.eigh(R.T @ (M @ R))
        keep = size > 1e-9 * size.max()
        R = R @ (axes[:, keep] / np.sqrt(size[keep]))
    square, turn = linalg.eigh(_symmetric(R.T @ (K @ R)), _symmetric(R.T @ (M @ R)))
    return np.maximum(square, 1e-300), R @ turn


def _power_of_two(value: float) -> float:
    """The nearest power of two, so that a shift does not depend on where the search for it began."""
    return float(2.0 ** np.round(np.log2(value)))


def rayleigh(K: Any, M: Any, shapes: np.ndarray) -> float:
    """The smaller Rayleigh quotient of two shapes (n, 2), which lean along x and along y."""
    return float(((shapes * (K @ shapes)).sum(0) / (shapes * (M @ shapes)).sum(0)).min())


def _main(square: np.ndarray, pull: np.ndarray, about: float, share: np.ndarray) -> list[int]:
    """The mode on which each of some loads (M, k) does most work, among those near the square of a frequency.

    A mode counts in which more than a few bits move, by the ``share`` of the mass that moves (M,), if there is one.
    """
    near = (square > NEAR[0] ** 2 * about) & (square < NEAR[1] ** 2 * about)
    near = near & (share > BITS) if (near & (share > BITS)).any() else near
    moved = pull**2 / square[:, None]
    return [int(k) for k in (moved * near[:, None] if near.any() else moved).argmax(0)]


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


def factor(matrix: Any) -> Any:
    """A function that solves with a symmetric positive sparse matrix."""
    import scipy.sparse.linalg as linalg

    options = {"SymmetricMode": True}
    return linalg.splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve


# ---- the cache


def analysis_of(total: Total, scene: int, most: int, guess: float | None = None) -> Analysis:
    """The modes of a scene, from the cache if the same body was analysed before.

    The cache is in the folder of compiled kernels, by the content of the body: its points, pins, relative masses and
    stiffnesses and its grid. A factor of all masses or moduli changes nothing in it.
    """
    path = cache_folder() / f"modes_{_content(total, scene, most)}.npz"
    numbers = _numbers(total, scene)
    found = _read(path, numbers)
    if found is None:
        found = Structure(total, scene).analyse(most, guess)
        _write(path, found, numbers)
    return found


def _content(total: Total, scene: int, most: int) -> str:
    points, digest = total.points, hashlib.sha256()
    count = points.count

    def add(*values: Any) -> None:
        for value in values:
            if isinstance(value, torch.Tensor):
                value = value.detach().cpu().contiguous().numpy()
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())

    add(_VERSION, SHIFT, LOOSE, CLUSTERS, STIFF_ROW, most, total.grid, points.attached)
    add(points.position.reshape(-1, count, 3)[scene], points.poisson_ratio.reshape(-1, count)[scene])
    add(total.kinds, total.rigid)
    for held in total.pinned:
        if held is not None:
            add(held.mass.reshape(-1, count)[scene] > 0, held.threshold)
    if total.pinned_rows is not None:
        rows = total.pinned_rows.rows
        add(rows.node[0, scene], rows.weight[0, scene].float(), rows.owner[0, scene])
    return digest.hexdigest()[:32]


def _numbers(total: Total, scene: int) -> np.ndarray:
    """Masses, volumes and stiffnesses of the points over their means, which rounding may change a little, (3, P)."""
    points = total.points
    own = [field.detach().reshape(-1, points.count)[scene] for field in (points.mass, points.volume, total.laws.mu)]
    return np.stack([(field / field.mean()).float().cpu().numpy() for field in own])


def _read(path: Path, numbers: np.ndarray) -> Analysis | None:
    """A kept analysis of a body of these numbers, to 1e-4; None if there is none that can be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if not np.allclose(file["numbers"], numbers, rtol=1e-4, atol=0):
                return None
            values = {f.name: file[f.name] for f in fields(Analysis)}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
    values["first"] = float(values["first"])
    values["second"], values["dropped"] = int(values["second"]), int(values["dropped"])
    return Analysis(**values)


def _write(path: Path, found: Analysis, numbers: np.ndarray) -> None:
    """Keep an analysis, and forget those that were used longest ago; a folder that cannot be written is no fault."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic(path) as temporary:
            kept: dict[str, Any] = {f.name: np.asarray(getattr(found, f.name)) for f in fields(Analysis)}
            np.savez(temporary, numbers=numbers, **kept)
        for old in sorted(path.parent.glob("modes_*.npz"), key=lambda p: p.stat().st_mtime)[:-KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return


__all__ = ["Analysis", "Structure", "analysis_of", "factor", "rayleigh"]
