"""The parts of things that fly from a pole, hang from a cord or stand on a trunk, by shape and colour."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.parts import Part
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.preview.hold import cord_heights
from gaussian_swaying.preview.parts import FoundParts, greenish, labelled, object_of, woody
from gaussian_swaying.preview.shape import FEWEST, breadth, plane_axes, quantile, sheet_normal

SLICES = 40  # of the height
SLIM = 0.04  # width of a pole, as a share of the height
BARE = 0.08  # share of the slices in which a pole is to be seen alone
CLOTH = 0.3  # width of a slice with cloth, as a share of the widest
OUTSIDE = 0.02  # share of the Gaussians of a flag that may lie on the other side of its pole
RIPPLED = 0.35  # depth of a flag over its length, seen from above
COLUMNS, LEVELS = 50, 20  # in which the posts of a washing line are looked for
THICK, ARM, HEM = 0.12, 0.1, 0.05  # width of a post and of its foot and arms beside it; height of the hem, as shares
FOOT = 5  # slices in which the ground around a trunk may be wide
RIM, POT = (0.25, 0.8), 0.15  # height of the rim of a pot, as a share of all; green share of what is below it
TRUNK, CROWN = 0.12, 0.5  # height of a bare trunk, as a share of that of the tree; green share of what is above
NARROW = 0.35  # width of a trunk, as a share of that of the crown
NECK, NECK_SHARE = 3.0, 0.1  # cells, share of the height: what bends above a hanging body
POST, SLENDER = 0.25, 0.08  # height of a post, as a share of that of the object, and its width, as a share of the same


def flag_on_pole(
    cloud: GaussianCloud, simulated: Tensor, up: Sequence[float]
) -> tuple[FoundParts, tuple[float, ...]] | None:
    """Find the pole of a flag: a slim upright part that is seen alone below or above a cloth, which is on one side.

    Args:
        cloud: The splat.
        simulated: The Gaussians of the object, bool, shape (N,).
        up: Up direction, a unit vector.

    Returns:
        The parts, a soft cloth and a still pole, and the unit vector from the cloth to its pole; None if it is not such
        a flag.
    """
    index, means, axis = object_of(cloud, simulated, up)
    aside = _along_sheet(means, axis)
    if aside is None:
        return None
    height, along = means @ axis, means @ aside
    low, high = float(height.amin()), float(height.amax())
    limit = SLIM * (high - low)
    which = ((height - low) / max(high - low, 1e-30) * SLICES).long().clamp(max=SLICES - 1)
    slices = [along[which == k] for k in range(SLICES)]
    if min(map(len, slices)) == 0:
        return None
    ends = [(quantile(own, 0.02), quantile(own, 0.98)) for own in slices]
    slim = [k for k, (first, last) in enumerate(ends) if last - first < limit]
    most = max(last - first for first, last in ends)
    wide = [k for k, (first, last) in enumerate(ends) if last - first > CLOTH * most]
    if len(slim) < BARE * SLICES or len(wide) < 3:
        return None
    middle = float(torch.tensor([0.5 * sum(ends[k]) for k in slim]).median())
    if any(abs(0.5 * sum(ends[k]) - middle) > limit for k in slim):
        return None  # it leans, or there are two
    radius = max(quantile(torch.cat([(slices[k] - middle).abs() for k in slim]), 0.98), 1e-3 * (high - low))
    beyond = [float(((sign * (along - middle)) > 3 * radius).double().mean()) for sign in (1.0, -1.0)]
    if min(beyond) > OUTSIDE or max(beyond) < 10 * OUTSIDE:
        return None
    toward = 1.0 if beyond[0] > beyond[1] else -1.0
    first, last = min(wide), max(wide)
    if any(float(((slices[k] - middle).abs() < 1.5 * radius).double().sum()) == 0 for k in range(first, last + 1)):
        return None  # the pole does not go through
    beside = (which >= first) & (which <= last)
    cloth = beside & (toward * (along - middle) > 1.4 * radius)
    if int(cloth.sum()) < FEWEST or int((~cloth).sum()) < FEWEST:
        return None
    share = len(slim) / SLICES
    reason = f"a slim upright pole, alone over {share:.2f} of its height, with a sheet on one side of it"
    parts = [Part("cloth"), Part("pole", "still")]
    found = labelled(cloud, index, (~cloth).long(), high - low, parts, reason)
    return found, tuple(float(-toward * c) + 0.0 for c in aside)


def sheet_between_posts(cloud: GaussianCloud, simulated: Tensor, up: Sequence[float]) -> FoundParts | None:
    """Find the posts of a washing line: slim columns from below the hem of an upright sheet to above it.

    Returns:
        The parts: posts with their feet and arms are still, line and cloth are soft; None without two posts.
    """
    index, means, axis = object_of(cloud, simulated, up)
    aside = _along_sheet(means, axis)
    if aside is None:
        return None
    height, along = means @ axis, means @ aside
    low, high = quantile(height, 0.005), quantile(height, 0.995)
    left, right = float(along.amin()), float(along.amax())
    if high <= low or right <= left:
        return None
    column = ((along - left) / (right - left) * COLUMNS).long().clamp(max=COLUMNS - 1)
    level = ((height - low) / (high - low) * LEVELS).long().clamp(0, LEVELS - 1)
    there = torch.zeros(COLUMNS, LEVELS).index_put_((column, level), torch.ones(1)) > 0
    whole = there.double().mean(1) > 0.9  # from the ground to the top
    runs = [list(own) for full, own in groupby(range(COLUMNS), lambda k: bool(whole[k])) if full]
    if len(runs) < 2 or max(map(len, runs)) > COLUMNS * THICK:
        return None
    place = [torch.isin(column, torch.tensor([run[0] - 1, *run, run[-1] + 1])) for run in runs]
    near = [(column >= run[0] - ARM * COLUMNS) & (column <= run[-1] + ARM * COLUMNS) for run in runs]
    between = ~torch.stack(near).any(0)
    if int(between.sum()) < FEWEST:
        return None
    hem, line = quantile(height[between], 0.01), quantile(height[between], 0.99)
    if hem < low + HEM * (high - low):
        return None
    post = torch.stack(place).any(0) | (torch.stack(near).any(0) & ((height < hem) | (height > line)))
    reason = f"a sheet that ends above the ground between {len(runs)} slim posts"
    return labelled(cloud, index, post.long(), high - low, [Part("cloth"), Part("post", "still")], reason)


def _along_sheet(means: Tensor, axis: Tensor) -> Tensor | None:
    """The level direction in an upright sheet, a unit vector; None if most of its upper half is no such sheet."""
    normal = sheet_normal(means)
    if normal is None:  # a foot makes the whole no sheet, and ripples the cloth
        upper = means @ axis
        cloth = means[upper > 0.5 * (quantile(upper, 0.01) + quantile(upper, 0.99))]
        level = cloth - cloth.mean(0)
        level = level - (level @ axis)[:, None] * axis
        values, axes = torch.linalg.eigh(torch.cov(level.T))  # the first is upright
        if float(values[1].clamp(min=0) / values[2].clamp(min=1e-30)) < RIPPLED**2:
            normal = tuple(axes[:, 1].tolist())
    if normal is None or abs(float(torch.tensor(normal, dtype=torch.float64) @ axis)) > 0.3:
        return None
    aside = torch.linalg.cross(axis, torch.tensor(normal, dtype=torch.float64))
    return aside / aside.norm()


def potted_parts(cloud: GaussianCloud, simulated: Tensor, up: Sequence[float], weight: Tensor) -> FoundParts | None:
    """The parts of a plant in a pot by colour alone: the lower part is not green and as wide as the plant.

    Returns:
        The parts: the pot is held, leaves are soft; None if there is no such pot.
    """
    index, means, axis = object_of(cloud, simulated, up)
    height, visible, green = means @ axis, weight[index].double(), greenish(cloud.sh.detach()[index])
    low, high = quantile(height, 0.005), quantile(height, 0.995)
    if high <= low:
        return None
    which = ((height - low) / (high - low) * SLICES).long().clamp(0, SLICES - 1)
    leafy, wide = [], []
    for k in range(SLICES):
        own = (which == k).nonzero()[:, 0]
        leafy.append(float((visible * green)[own].sum() / visible[own].sum().clamp(min=1e-30)))
        wide.append(breadth(means[own], plane_axes(axis), 0.05))
    rim = next((k for k in range(SLICES) if leafy[k] > 0.5), SLICES)
    if not RIM[0] * SLICES <= rim < RIM[1] * SLICES:
        return None
    if sum(leafy[:rim]) > POT * rim or min(wide[:rim]) < 0.4 * max(wide) or sum(leafy[rim:]) < 0.5 * (SLICES - rim):
        return None
    label = torch.where(which < rim, 0, 1)
    reason = f"not green and as wide as the rest up to {rim / SLICES:.2f} of the height, and green above"
    return labelled(cloud, index, label, high - low, [Part("pot", "held"), Part("leaf")], reason)


def swinging_parts(
    cloud: GaussianCloud, simulated: Tensor, up: Sequence[float], weight: Tensor, hook: Region, cell: float
) -> FoundParts:
    """The parts of a thing that hangs: its upper end is held, a cord or neck below it bends, and the rest is rigid.

    See :func:`~gaussian_swaying.preview.parts.plant_parts`; ``hook`` is the upper end, ``cell`` the grid spacing [scene
    units].
    """
    index, means, axis = object_of(cloud, simulated, up)
    height = means @ axis
    size = float(height.amax() - height.amin())
    held = hook.contains(cloud.means.detach())[index]
    ends = cord_heights(means, weight[index].double(), axis)
    lowest = float(height[held].amin()) if bool(held.any()) else float(height.amax())
    bends = lowest - max(NECK * cell, NECK_SHARE * size) if ends is None else min(ends[0], lowest - NECK * cell)
    label = torch.where(height > bends, 1, 2)
    label[held] = 0
    what = f"a neck of {(lowest - bends) / size:.2f} of the height" if ends is None else "a cord"
    parts = [Part("hook", "held"), Part("cord"), Part("body", "rigid")]
    return labelled(cloud, index, label, size, parts, f"it hangs from its upper end by {what}")


def standing_parts(
    cloud: GaussianCloud, simulated: Tensor, up: Sequence[float], weight: Tensor, depth: float
) -> FoundParts | None:
    """Find the trunk of a tree, narrow and not green, below a crown that is green; or the post of another thing.

    Its foot has a depth [scene units].

    Returns:
        The parts: the foot is held, wood and leaves are soft, or post and head; None if there is no such trunk or post.
    """
    index, means, axis = object_of(cloud, simulated, up)
    height, visible = means @ axis, weight[index].double()
    low, high = quantile(height, 0.002), quantile(height, 0.998)
    if high <= low:
        return None
    share = (height - low) / (high - low)
    green = greenish(cloud.sh.detach()[index])
    which = (share * SLICES).long().clamp(0, SLICES - 1)
    wide = [breadth(means[which == k], plane_axes(axis), 0.05) for k in range(SLICES)]
    most = max(wide)
    start = next((k for k in range(FOOT) if 0 < wide[k] < NARROW * most), 0)  # above a lawn or a disc of soil
    bare = next((k for k in range(start, SLICES) if not 0 < wide[k] < NARROW * most), SLICES)
    if not TRUNK * SLICES <= bare < 0.85 * SLICES:
        return None
    trunk, crown, ground = (which < bare) & (which >= start), which >= bare, which < start
    brown, leafy = (
        float((visible * of)[some].sum() / visible[some].sum()) for of, some in ((~green, trunk), (green, crown))
    )
    tree = brown >= 0.8 and leafy >= CROWN
    slim = start == 0 and max(wide[:bare]) < SLENDER * (high - low)
    if not tree and (leafy >= CROWN or bare < POST * SLICES or not slim):
        return None
    label = torch.where(trunk | woody(means, green, high - low) if tree else trunk, 1, 2)
    label[ground | (trunk & (height < quantile(height[trunk], 0.01) + depth))] = 0
    if int((label == 2).sum()) < FEWEST:
        return None
    names = ("wood", "leaf") if tree else ("post", "head")
    what = "a trunk, bare" if tree else "a post, slim"
    above = "green" if tree else "something wider"
    reason = f"{what} up to {bare / SLICES:.2f} of the height, and {above} above"
    return labelled(cloud, index, label, high - low, [Part("foot", "held"), *map(Part, names)], reason)
