r"""Labels that spread from a few Gaussians to all others, by minimum cuts on the graph of neighbours.

A label costs a Gaussian by the difference of its colour from those that carry the label, and by the way from them along
neighbours: without the latter, a few Gaussians would be cut out as an island. Two neighbours with different labels cost
the more, the more alike and the closer they are:
:math:`w = \exp(-\lVert c_1 - c_2\rVert^2 / 2\sigma^2 - (1 - |n_1 \cdot n_2|) - d^2 / 2 h^2)`. Single Gaussians of a
capture have any colour, so c is the mean of those around that do not differ far more than most. With two labels
one cut gives the least cost (Boykov & Jolly 2001); with more, each label in turn takes what lowers the cost, until none
does (alpha-expansion: Boykov, Veksler & Zabih 2001).

Of more than ``MOST`` Gaussians, those in a cell of like colour are one node of the graph.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape, check_whole
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.groups import equal_rows, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours, particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal

MOST = 60_000  # nodes of a graph
NEIGHBOURS = 10
SHADES = 6  # of red, green and blue, that separate the Gaussians of a cell
LEAST_SIGMA = 0.03  # differences of colour below this are noise, from 0 to 1
BLURS, LOOSE = 2, 3.0  # times that colours are averaged with those of neighbours; medians that these may differ
COLOURS = 8  # of a label, to which others are compared
WAY, BORDER = 0.25, 3.0  # share of the way in the cost of a label; cost of a border of alike neighbours
WHOLE = 1000  # costs are whole numbers of a thousandth
ROUNDS = 5  # of alpha-expansion; two or three do


def spread_labels(cloud: GaussianCloud, seeds: Tensor, count: int, smooth: float = 1.0) -> Tensor:
    """The label of each Gaussian, from those of a few.

    Args:
        cloud: The splat.
        seeds: Labels from 0 on, which stay, and -1 where the label is looked for, int64, shape (N,).
        count: Number of labels.
        smooth: What a border between labels costs beside differences of colour: above 1 for smoother borders.

    Returns:
        Labels from 0 to ``count`` - 1, int64, shape (N,). The same input gives the same labels.

    Raises:
        ValueError: If a label has no seed, or is out of range.
    """
    check_whole("count", count, 1)
    check_positive("smooth", smooth)
    check_shape("seeds", seeds, len(cloud))
    seeds = seeds.cpu().long()
    if len(seeds) and not -1 <= int(seeds.min()) <= int(seeds.max()) < count:
        raise ValueError(f"Expected `seeds` from -1 to {count - 1}, but they go from {seeds.min()} to {seeds.max()}.")
    missing = sorted(set(range(count)) - set(seeds.tolist()))
    if missing:
        raise ValueError(f"The label {missing[0]} has no seed: give each of the {count} labels at least one Gaussian.")
    means = cloud.means.detach().cpu().double()
    colour = (0.5 + SH_DC * cloud.sh.detach().cpu()[:, 0].double()).clamp(0, 1)
    normal = smallest_axis_normal(cloud.quats, cloud.scales).detach().cpu().double()
    node = _nodes(means, colour, seeds)
    many = torch.bincount(node).double()[:, None]
    place, shade = sums(means, node) / many, sums(colour, node) / many
    facing = torch.linalg.eigh(sums(normal[:, :, None] * normal[:, None, :], node))[1][:, :, -1]
    seed = torch.full((len(many),), -1).scatter_reduce_(0, node, seeds, "amax")
    if len(place) == 1 or count == 1:
        return torch.zeros_like(seeds).to(cloud.means.device) + int(seeds.max())
    distance, index = nearest_neighbours(place, min(NEIGHBOURS, len(place) - 1))
    opaque = sums(cloud.opacities.detach().cpu().double().sigmoid(), node)
    for _ in range(BLURS):
        shade = _blurred(shade, opaque, index)
    pairs, apart = _edges(distance, index)
    weight = _likeness(pairs, apart, shade, facing)
    cost = (1 - WAY) * _colour_costs(shade, seed, count) + WAY * _ways(pairs, apart, seed, count)
    label = torch.where(seed >= 0, seed, cost.argmin(-1))
    edge = torch.round(WHOLE * BORDER * smooth * weight).long() + 1
    own = torch.round(WHOLE * cost).long()
    forced = min(int(edge.sum()) + int(own.sum()) + 1, 2**30)
    own = torch.where((seed >= 0)[:, None], forced, own)
    known = (seed >= 0).nonzero()[:, 0]
    own[known, seed[known]] = 0
    if count == 2:
        label = _expanded(torch.zeros_like(label), 1, own, pairs, edge)  # one cut is enough
    for _ in range(ROUNDS if count > 2 else 0):
        before = label
        for alpha in range(count):
            label = _expanded(label, alpha, own, pairs, edge)
        if torch.equal(label, before):
            break
    return label[node].to(cloud.means.device)


def _nodes(means: Tensor, colour: Tensor, seeds: Tensor) -> Tensor:
    """The node of each Gaussian: itself, or of many those of a cell with like colours and the same seed; shape (N,)."""
    if len(means) <= MOST:
        return torch.arange(len(means))
    cell = particle_spacing(means) * (len(means) / MOST) ** 0.5
    shade = (colour * SHADES).floor().clamp(max=SHADES - 1)
    while True:
        node = equal_rows(torch.cat([(means / cell).floor(), shade, seeds[:, None].double()], -1))
        found = int(node.max()) + 1
        if found <= MOST:
            return node
        cell *= max(1.1, (found / MOST) ** 0.5)


def _blurred(shade: Tensor, opaque: Tensor, index: Tensor) -> Tensor:
    """Colours averaged with those of neighbours (M, K) that do not differ far more than most, shape (M, 3)."""
    around = torch.cat([torch.arange(len(shade))[:, None], index], -1)
    change = (shade[around] - shade[:, None]).square().sum(-1)
    sigma = max(LOOSE * float(change[:, 1:].sqrt().median()), LEAST_SIGMA)
    weight = (opaque[around] + 1e-30) * torch.exp(-change / (2 * sigma**2))
    return (weight[..., None] * shade[around]).sum(1) / weight.sum(1)[:, None]


def _edges(distance: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs of neighbours, shape (2, E), the first below the second, and their distances, (E,)."""
    nodes = len(index)
    first = torch.arange(nodes)[:, None].expand_as(index)
    key = torch.minimum(first, index) * nodes + torch.maximum(first, index)
    found, back = torch.unique(key.reshape(-1), return_inverse=True)
    apart = torch.zeros(len(found), dtype=torch.float64).scatter_(0, back, distance.double().reshape(-1))
    return torch.stack([found // nodes, found % nodes]), apart


def _likeness(pairs: Tensor, apart: Tensor, shade: Tensor, facing: Tensor) -> Tensor:
    """Likeness of two neighbours, from 0 to 1, shape (E,)."""
    a, b = pairs
    change = (shade[a] - shade[b]).square().sum(-1)
    sigma = max(float(change.sqrt().median()), LEAST_SIGMA)
    reach = 2 * max(float(apart.median()), 1e-30)
    bend = 1 - (facing[a] * facing[b]).sum(-1).abs()
    return torch.exp(-change / (2 * sigma**2) - bend - apart.square() / (2 * reach**2))


def _ways(pairs: Tensor, apart: Tensor, seed: Tensor, count: int) -> Tensor:
    """Costs of the labels of a node by the way from their seeds, from 0 to 1, shape (M, count)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    a, b = pairs.numpy()
    both = np.concatenate([apart.numpy(), apart.numpy()]) + 1e-12 * max(float(apart.max()), 1e-30)
    graph = coo_matrix((both, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(len(seed),) * 2).tocsr()
    ways = [
        torch.from_numpy(dijkstra(graph, indices=(seed == label).nonzero()[:, 0].numpy(), min_only=True))
        for label in range(count)
    ]
    way = torch.stack(ways, -1)
    far = 2 * way[way.isfinite()].max() + 1e-30  # no way leads there
    way = way.clamp(max=float(far)) + max(float(apart.median()), 1e-30)
    return way / way.sum(-1, keepdim=True)


def _colour_costs(shade: Tensor, seed: Tensor, count: int) -> Tensor:
    """Costs of the labels of a node by its colour, from 0 to 1, shape (M, count)."""
    apart = []
    for label in range(count):
        own = shade[seed == label]
        palette = own[torch.linspace(0, len(own) - 1, min(COLOURS, len(own))).round().long()]
        apart.append(torch.cdist(shade, palette, compute_mode="donot_use_mm_for_euclid_dist").amin(-1).square())
    apart_from = torch.stack(apart, -1) + LEAST_SIGMA**2
    return apart_from / apart_from.sum(-1, keepdim=True)


def _expanded(label: Tensor, alpha: int, own: Tensor, pairs: Tensor, edge: Tensor) -> Tensor:
    """The labels of least cost of all in which some nodes change to ``alpha``.

    Args:
        label: Labels now, shape (M,).
        alpha: The label.
        own: Costs of the labels of a node, whole numbers, shape (M, count).
        pairs: Neighbours, shape (2, E).
        edge: Costs of a border between them, whole numbers, shape (E,).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    nodes = len(label)
    a, b = pairs
    changed = own[:, alpha] - own.gather(1, label[:, None])[:, 0]
    # a border costs A as it is, B if only the second node changes, C if only the first one does, and nothing if both do
    A, B, C = ((edge * (x != y)) for x, y in ((label[a], label[b]), (label[a], alpha), (alpha, label[b])))
    changed = changed.index_add(0, a, C - A).index_add(0, b, -C)
    across = B + C - A
    source, sink = nodes, nodes + 1
    stays, goes = (changed > 0).nonzero()[:, 0], (changed < 0).nonzero()[:, 0]
    rows = torch.cat([a, torch.full_like(stays, source), goes]).numpy()
    columns = torch.cat([b, stays, torch.full_like(goes, sink)]).numpy()
    values = torch.cat([across, changed[stays], -changed[goes]]).clamp(max=2**30).numpy().astype(np.int32)
    graph = coo_matrix((values, (rows, columns)), shape=(nodes + 2, nodes + 2)).tocsr()
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    kept = np.zeros(nodes + 2, dtype=bool)
    kept[breadth_first_order(left, source, return_predecessors=False)] = True
    return torch.where(torch.from_numpy(kept[:nodes]), label, alpha)
