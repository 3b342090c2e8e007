"""Points between the centres of Gaussians that are too far apart for a grid."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.rotations import quat_to_rotation

_VISIBLE = 0.25  # smallest opacity at which a Gaussian counts as surface
_NEAR = 0.5**0.5  # points closer than this to another, in spacings, add nothing: as in the middle of a square
_SMOOTH = 0.6  # standard deviations of split Gaussians, in steps of their lattice
_ROUNDS = 3  # of attempts with the next point of a cell
_MOST = 5_000_000  # points before those that are too close are removed


@dataclass(frozen=True)
class Subdivision:
    """Gaussians cut into pieces no larger than a spacing.

    Attributes:
        parent: The Gaussian of each extra piece, shape (K,).
        means: Centres of the extra pieces [scene units], shape (K, 3).
        log_scales: Logarithms of the standard deviations of all pieces [scene units]: first the pieces in the middle of
            each Gaussian, then the extra ones, shape (N + K, 3).
        opacity: Opacities of all pieces: the opacity of the Gaussian at the centre of the piece, shape (N + K,).
    """

    parent: Tensor
    means: Tensor
    log_scales: Tensor
    opacity: Tensor


@torch.no_grad()
def subdivide(means: Tensor, quats: Tensor, log_scales: Tensor, opacity: Tensor, spacing: float) -> Subdivision:
    r"""Points on large Gaussians, so that no two neighbours on the surface are much farther apart than a spacing.

    Training leaves large Gaussians where a surface has only one colour. With one material point per Gaussian there
    would be holes that a fine grid does not bridge. So points are placed a spacing apart on the ellipse where a
    Gaussian has at least a quarter of full opacity, :math:`o \exp(-m^2 / 2) \ge 1/4` at the Mahalanobis distance m in
    its plane. The centre of the Gaussian is one of them. A point closer than :math:`\sqrt{1/2}` spacings to the centre
    of any Gaussian, or to a point that is nearer to the centre of its own Gaussian, is left out, because there is
    already a point at that place.

    Args:
        means: Centres [scene units], shape (N, 3).
        quats: Rotations, wxyz, of any length above zero, shape (N, 4).
        log_scales: Logarithms of the standard deviations [scene units], shape (N, 3).
        opacity: Opacities from 0 to 1, shape (N,).
        spacing: Largest distance of neighbours [scene units].

    Returns:
        The pieces, the same on every device. Gaussians with at most a quarter of full opacity stay whole.
    """
    device, kind = means.device, means.dtype
    means, quats, log_scales, opacity = (t.detach().cpu() for t in (means, quats, log_scales, opacity))
    reach = _reach(opacity.double())
    half = reach[:, None] * log_scales.double().exp()
    normal_axis = log_scales.argmin(-1)
    half[torch.arange(len(means)), normal_axis] = 0
    # an odd number along each axis, so that the centre is among them
    pieces = (2 * (half / spacing - 0.5).ceil().clamp_min(0) + 1).clamp_max(_MOST).long()
    large = (pieces > 1).any(-1).nonzero()[:, 0]
    most = max(_MOST, 9 * len(large))  # three along each axis is the least that a large one has
    if float(pieces[large].double().prod(-1).sum()) > most:
        widest = float(half.amax() / spacing)
        raise ValueError(
            f"Some Gaussians extend over {widest:.3g} spacings of {spacing:.3g}, which is too many points: raise the "
            "spacing (`scene.particle_spacing`), or exclude such haze with `scene.region` or "
            "`scene.opacity_threshold`."
        )
    step = 2 * half / pieces
    row, steps = _lattice(pieces[large] // 2)
    parent = large[row]
    place = steps * step[parent]
    squared = (place / half[parent].clamp_min(1e-300)).square().sum(-1)  # 1 on the rim of the ellipse
    inside = (squared > 0) & (squared <= 1)
    parent, place, squared = parent[inside], place[inside], squared[inside]
    turned = (quat_to_rotation(quats.double())[parent] @ place[..., None])[..., 0]
    where = means.double()[parent] + turned
    kept = _thin(where, squared * reach[parent].square(), means.double(), _NEAR * spacing)
    parent, where, squared = parent[kept], where[kept], squared[kept]
    shrunk = log_scales.double() - pieces.double().log()
    faded = opacity.double()[parent] * (-0.5 * squared * reach[parent].square()).exp()
    return Subdivision(
        parent.to(device),
        where.to(device, kind),
        torch.cat([shrunk, shrunk[parent]]).to(device, kind),
        torch.cat([opacity.double(), faded]).to(device, kind),
    )


@dataclass(frozen=True)
class Split:
    """Gaussians that replace larger ones.

    Attributes:
        source: The original Gaussian of each, shape (M,); the first N are in order.
        means: Centres [scene units], shape (M, 3).
        log_scales: Logarithms of the standard deviations [scene units], shape (M, 3).
        opacity: Opacities, shape (M,).
    """

    source: Tensor
    means: Tensor
    log_scales: Tensor
    opacity: Tensor


@torch.no_grad()
def split_large(means: Tensor, quats: Tensor, log_scales: Tensor, opacity: Tensor, size: float) -> Split:
    """Replace large Gaussians by ones no larger than a size; further training smooths the picture.

    Their centres are the points of :func:`subdivide`, on a lattice with steps of at most 5/3 of the size. Their size is
    0.6 steps, so that together they look nearly uniform.

    Args:
        means: Centres [scene units], shape (N, 3).
        quats: Rotations, wxyz, of any length above zero, shape (N, 4).
        log_scales: Logarithms of the standard deviations [scene units], shape (N, 3).
        opacity: Opacities from 0 to 1, shape (N,).
        size: Largest standard deviation [scene units].

    Returns:
        All Gaussians. Those with at most a quarter of full opacity do not change, whatever their size.
    """
    large = log_scales.exp().amax(-1) > size
    pieces = subdivide(means, quats, log_scales, torch.where(large, opacity, 0), size / _SMOOTH)
    source = torch.cat([torch.arange(len(means), device=means.device), pieces.parent])
    reach = _reach(opacity)[source, None]
    divided = (pieces.log_scales[: len(means)] < log_scales - 1e-6)[source]
    scales = pieces.log_scales + torch.where(divided, (2 * _SMOOTH * reach).clamp_min(1e-6).log(), 0)
    peak = torch.cat([opacity, pieces.opacity[len(means) :]])
    return Split(source, torch.cat([means, pieces.means]), scales.to(log_scales.dtype), peak)


def _reach(opacity: Tensor) -> Tensor:
    """Mahalanobis distance at which a Gaussian's opacity falls to a quarter; 0 if it is less everywhere."""
    return (2 * (opacity / _VISIBLE).clamp_min(1).log()).sqrt()


def _lattice(out: Tensor) -> tuple[Tensor, Tensor]:
    """All integer triples between minus and plus a row, for each row of (N, 3): its row (L,), and the triple (L, 3)."""
    sizes = 2 * out + 1
    length = sizes.prod(-1)
    row = torch.repeat_interleave(torch.arange(len(out)), length)
    rank = torch.arange(len(row)) - (length.cumsum(0) - length)[row]
    x, y, z = sizes[row].unbind(-1)
    steps = [rank % x, rank.div(x, rounding_mode="floor") % y, rank.div(x * y, rounding_mode="floor") % z]
    return row, (torch.stack(steps, -1) - out[row]).double()


def _thin(points: Tensor, order: Tensor, taken: Tensor, distance: float) -> Tensor:
    """Indices of points that are at least a distance from those already taken, and about as far from each other.

    Of several in one cell of a grid the first by ``order`` is tried; if it is too close to those taken, the next one.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long)
    everything = torch.cat([taken, points])
    ranked = torch.cat([torch.arange(len(taken)), order.argsort(stable=True) + len(taken)])
    pool = _first_in_cell(everything, ranked, 0.5 * distance, 0.0)  # many Gaussians overlap
    pool, kept = pool[pool >= len(taken)], pool[:0]
    for _ in range(_ROUNDS):
        tried = pool
        for shift in (0.0, 0.5):  # two grids, so that most pairs share a cell in one
            tried = _first_in_cell(everything, tried, distance, shift)
        far, _ = nearest_neighbours(torch.cat([taken, everything[kept]]), 1, everything[tried])
        kept = torch.cat([kept, tried[far[:, 0] >= distance]])
        pool = pool[~torch.isin(pool, tried)]
    return kept.sort().values - len(taken)


def _first_in_cell(points: Tensor, ranked: Tensor, size: float, shift: float) -> Tensor:
    cell = torch.floor(points[ranked] / size + shift).long()
    cell -= cell.amin(0) if len(cell) else 0
    extent = cell.amax(0) + 1 if len(cell) else cell.new_ones(3)
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    sorted_key, by_key = key.sort(stable=True)
    first = torch.ones(len(key), dtype=torch.bool)
    first[1:] = sorted_key[1:] != sorted_key[:-1]
    return ranked[by_key[first].sort().values]
