"""Openness of patches: the share of each that the wind from outside can reach, measured with rays, like light."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._parallel import in_threads
from gaussian_swaying.geometry.directions import axes_across, spread_lines

LEAST = 1e-3
"""Smallest weight: a patch that nothing reaches keeps a trace of area, so that no material point is without mass."""

_LINES = 24  # lines along which light is followed, each both ways
_COLUMN = 2.5  # side of a column of light, in roots of the median area
_OWN = 0.4  # half thickness of what counts as the sheet of a patch, in sizes of the patch
_SKIN = 1.5  # half thickness of what shares the light of a gap, in sizes of the patch
_FACING = 0.35  # cosine below which a line says nothing about a patch
_THROUGH = 0.6  # cosine below which a line is not looked along for a gap
_DARK = 3.0  # a gap must be clear even if everything were so many times thicker
_GAP = (0.01, 0.04)  # share of the lines' ends that are gaps, where a patch starts to count and where it counts fully
_OPAQUE = 0.99  # largest opacity; the optical depth of 1 would be infinite
_FINE = 2.0  # parts that are cut from an area as large as the cross-section of a column
_PIECES = 256  # parts of a patch, at most
_PARTS = 3  # parts of a patch on average, at most
_AT_ONCE = 2_000_000  # parts in memory together, on lines that are followed side by side
_WIDE = 4096  # columns side by side, and depth of the picture in sides of a column; the rest is moved to its border


@torch.no_grad()
def openness(
    means: Tensor, normals: Tensor, log_scales: Tensor, areas: Tensor, opacity: Tensor | None = None
) -> Tensor:
    r"""Share of each patch that is open to the outside; the weighted areas add up to the outer skin.

    Areas of :func:`~gaussian_swaying.gaussians.area.coverage_area` count every sheet, also those behind the skin of a
    captured object. Light from all sides finds the skin: it is what absorbs the light. Patch i has an optical depth
    :math:`\tau_i = -\log(1 - o_i)`. Along a line of direction :math:`\omega` it is in a column of light of
    cross-section :math:`p^2`, at the depth where its plane meets the middle of the column, and adds
    :math:`\tau_i A_i |n_i \cdot \omega| / p^2` to the optical depth there. With :math:`t^+` and :math:`t^-` in front
    of its sheet and behind it, :math:`t^0` in its sheet and t in the whole column, the patch absorbs

    .. math::
        \ell_i(\omega) = \bigl(e^{-t^+} + e^{-t^-}\bigr) \frac{1 - e^{-t^0}}{1 - e^{-t}} \frac{\tau_i}{t^0}

    of the light that arrives at its area from both ends of the line. The first factor is what reaches its sheet, the
    second what the sheet keeps, as a share of all that is kept, and the third the patch's share in its sheet. The mean
    over the lines within 70 degrees of the normal, weighted by :math:`|n_i \cdot \omega|`, is 1 on the skin of a closed
    body, which gets light from one side, and 2 on a free sheet, whatever the opacity. The layers of a hazy skin share
    the 1, as light is absorbed only once. Inside a body it is near 0. The weight is

    .. math::
        w_i = \min\bigl(1, \max(\bar\ell_i, s_i g_i)\bigr)

    The second term is for leaves that shade each other. There light comes through gaps: from few directions, but from
    these undimmed. An end of a line within 53 degrees of the normal is a gap if at least half its light would arrive
    even through three times the optical depth, which haze does not let through. :math:`g_i` grows from 0 to 1 while the
    share of gaps, weighted in the same way, grows from 1 to 4 %. :math:`s_i` is like the product of the second and
    third factor, for what is within 1.5 sizes of the patch.

    Columns are 2.5 roots of the median area wide, and a sheet is 0.4 sizes thick on either side. The size is the
    root of the area or twice the standard deviation of the Gaussian, whichever is smaller. So two skins closer than
    about a spacing are not told apart, and neither is what hides less than two spacings below a skin. A free sheet
    whose patches are scattered more than that has two faces, and counts up to twice.
    Leaves that are spread evenly keep their area up to a leaf area index of about 2; denser ones, and bunches of
    leaves, look like a hazy skin and lose part of it.

    Patches larger than half the cross-section of a column are cut into up to 256 parts, spread over a disc as large as
    the ellipse of two standard deviations. On average a patch has at most three, so light leaks between the parts where
    many patches are a hundred times larger than the median. Computed in float64 on the CPU, the same on every device;
    not differentiable. The lines are fixed, so a rotation changes the sum by about a percent.

    Args:
        areas: Areas without shadow, above zero [scene units^2], shape (N,).
        opacity: Opacities from 0 to 1, shape (N,); None if all are opaque.

    Returns:
        Weights from :data:`LEAST` to 1, shape (N,).
    """
    count = len(means)
    if count == 0:
        return means.new_zeros(0)
    place, normal, scale, area = (t.detach().cpu().double() for t in (means, normals, log_scales, areas))
    main = normal.gather(1, normal.abs().argmax(-1, keepdim=True))
    normal = torch.where(main < 0, -normal, normal)  # either sign gives the same parts
    solid = torch.ones(count) if opacity is None else opacity.detach().cpu()
    depth = -torch.log1p(-solid.double().clamp(1e-6, _OPAQUE))
    area = area.clamp_min(torch.finfo(torch.float32).tiny)
    size = torch.minimum(area.sqrt(), (scale.sum(-1) - scale.amin(-1)).mul(0.5).exp() * 2)
    size = size.clamp_min(1e-9 * float(area.median().sqrt()))
    column = _COLUMN * float(area.median().sqrt())
    owner, part, pieces = _cut(place, normal, scale, area, column)
    part = (part - place.median(0).values) / column
    lines = spread_lines(_LINES)

    def along(number: int, line: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """Along one line: the patches, with their light, shares of the skin, gaps and weights."""
        turn = torch.stack([first, second, line], dim=-1)
        facing = normal @ turn
        cosine = facing[:, 2].abs()
        own = depth * (area * cosine / (pieces * column**2)).clamp_max(1)  # of one part in its column
        key = _keys(part @ turn, facing.index_select(0, owner), number)
        order = torch.from_numpy(np.argsort(key.numpy()))  # several times faster than torch's, as is its search
        key = key.index_select(0, order)
        of_patch = order < count  # the first part of a patch is its middle
        patch, key_of = order[of_patch], key[of_patch]
        passed = torch.cat([own.new_zeros(1), own.index_select(0, owner.index_select(0, order)).cumsum(0)])
        fields = (cosine, own.clamp_min(1e-12), depth, size)
        cosine, own, tau, reach = (field.index_select(0, patch) for field in fields)
        reach = reach / (column * _WIDE * cosine.clamp_min(_FACING))
        before, near, after, wide = _split(key, key_of, passed, _OWN * reach, _SKIN * reach)
        near, wide = torch.maximum(near, own), torch.maximum(wide, own)
        kept = -torch.expm1(-(before + near + after))
        weight = torch.where(cosine > _FACING, cosine, 0)
        arriving = (-before).exp() + (-after).exp()
        clear = (_DARK * before < math.log(2)).double() + (_DARK * after < math.log(2)).double()
        light = weight * arriving * (-torch.expm1(-near) / kept) * (tau / near)
        shares = weight * (-torch.expm1(-wide) / kept) * (tau / wide)
        return patch, light, shares, torch.where(cosine > _THROUGH, 0.5 * weight * clear, 0), weight

    light, shares, gaps, total = sums = [torch.zeros(count, dtype=torch.float64) for _ in range(4)]
    each = range(_LINES), lines, *axes_across(lines)
    threads = min(torch.get_num_threads(), _AT_ONCE // len(part))
    for patch, *found in in_threads(along, *each, threads=threads):
        for whole, of_line in zip(sums, found, strict=True):
            whole.index_add_(0, patch, of_line)
    low, high = _GAP
    gap = ((gaps / total - low) / (high - low)).clamp(0, 1)
    return torch.maximum(light / total, (shares / total).clamp_max(1) * gap).clamp(LEAST, 1).to(means)


def _cut(
    place: Tensor, normal: Tensor, log_scales: Tensor, area: Tensor, column: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Parts of patches no larger than the cross-section of a column: patch and centre of each, and parts of each patch.

    The first part of each patch is its middle, in the order of the patches; the others follow, on a spiral over a disc
    as large as the patch, or as the ellipse of two standard deviations if that is larger. There are at most ``_PARTS``
    times as many parts as patches.
    """
    most = _PIECES
    pieces = (_FINE * area / column**2).ceil().clamp(1, most).long()
    while most > 1 and int(pieces.sum()) > _PARTS * len(area):
        most //= 2
        pieces = pieces.clamp_max(most)
    first = torch.arange(len(area))
    owner = first.repeat_interleave(pieces - 1)
    if len(owner) == 0:
        return first, place, pieces
    number = 1 + torch.arange(len(owner)) - ((pieces - 1).cumsum(0) - (pieces - 1))[owner]
    extent = torch.maximum(area / math.pi, 4 * (log_scales.sum(-1) - log_scales.amin(-1)).exp())
    radius = ((number + 0.5) / pieces[owner] * extent[owner]).sqrt()
    angle = number * (math.pi * (3 - math.sqrt(5)))
    across, along = axes_across(normal[owner])
    out = (radius * angle.cos())[:, None] * across + (radius * angle.sin())[:, None] * along
    return torch.cat([first, owner]), torch.cat([place, place[owner] + out]), pieces


def _keys(place: Tensor, facing: Tensor, number: int) -> Tensor:
    """Column (whole part) and depth (fraction) of parts, from place and normal along its two axes and the line, (M, 3).

    Places are in sides of a column. The depth is that of the part's plane in the middle of its column: the parts of a
    flat sheet have the same depth, also where it is oblique. The lattice of columns differs from line to line.
    """
    shift = torch.tensor([number * 0.6180339887498949 % 1, number * 0.3819660112501051 % 1], dtype=torch.float64)
    lateral = (place[:, :2] + shift + _WIDE // 2).clamp(0, _WIDE - 1)
    cell = lateral.floor()
    to_middle = cell + 0.5 - lateral
    slope = to_middle[:, 0] * facing[:, 0] + to_middle[:, 1] * facing[:, 1]
    along = facing[:, 2]
    depth = place[:, 2] - slope / torch.where(along < 0, -1.0, 1.0) / along.abs().clamp_min(_FACING)
    return cell[:, 0] * _WIDE + cell[:, 1] + (depth / _WIDE + 0.5).clamp(0, 1 - 2.0**-24)


def _split(
    key: Tensor, at: Tensor, passed: Tensor, sheet: Tensor, skin: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Optical depths of columns: in front of the sheet of a patch, in the sheet, behind it, and in the skin around it.

    Args:
        key: Column and depth of all parts, ascending, shape (M,).
        at: Those of the places, ascending, shape (N,).
        passed: Optical depth of all parts before each, shape (M + 1,).
        sheet: Half the thickness of the sheet of each place, as a share of a column's length, shape (N,).
        skin: The same of the skin, shape (N,).
    """
    low = at.floor()
    high = low + 1

    def depth(place: Tensor) -> Tensor:
        return passed.index_select(0, torch.from_numpy(np.searchsorted(key.numpy(), place.numpy())))

    begin, end = depth(low), depth(high)
    front, back = depth(torch.maximum(at - sheet, low)), depth(torch.minimum(at + sheet, high))
    wide = depth(torch.minimum(at + skin, high)) - depth(torch.maximum(at - skin, low))
    return front - begin, back - front, end - back, wide
