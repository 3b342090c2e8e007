"""The parts of a plant in a pot, by shape and colour: pot, soil, stems and leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.groups import equal_rows, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.preview.shape import FEWEST, plane_axes, quantile

GREEN = 0.08  # how much greener than red and blue, as a share of the brightness
SLICES, SECTORS = 40, 16  # of the height; of a slice
COVERED = 0.75  # share of the sectors of a slice in which a pot must be
ROUND = 0.12  # standard deviation of its radius over the sectors, as a share of the radius
POT, SLENDER = (0.05, 0.6), 5.0  # height of a pot, as a share of that of the object; most radii, or it is a trunk
PLANT, LEAFY = 0.1, 0.5  # share of the visible area that must be above the rim, and the share of it that must be green
WALL, SAUCER = 0.88, 1.25  # radii from the axis between which the wall lies, as shares of the radius there
OPENING, INSIDE = 0.7, 0.4  # part of the radius in which soil is looked for, and share of its cells that must have some
LEVEL = 0.015  # of the height: how far above its plane soil may lie
NEIGHBOURS = 12  # whose most frequent label a Gaussian near the pot gets
CELL, NEAR = 0.006, 0.03  # of the height: cells in which shapes are looked at, and how far around
SEEN = 8  # cells around that show a shape
HAZE, TOUCHES = 0.1, 2.0  # opacity below which a Gaussian lies on what it touches; standard deviations that it reaches
THIN, LONG, THREAD = 0.25, 0.5, 0.12  # third over second variance of the places around, and second over first (twice)

POT_LABEL, SOIL, STEM, LEAF, AROUND = range(5)
NAMES = ("pot", "soil", "stem", "leaf", "surroundings")


@dataclass(frozen=True)
class FoundParts:
    """The parts of an object.

    Attributes:
        parts: A label for each Gaussian of the splat.
        reason: What was found, in words.
        path: The file that a configuration names.
    """

    parts: Parts
    reason: str
    path: str = "parts.npz"

    @property
    def still(self) -> Tensor:
        """The Gaussians that are drawn and not simulated, bool, shape (N,)."""
        return self.parts.mask(role="still")

    @property
    def around(self) -> Tensor:
        """Those among them that are not of the object, bool, shape (N,)."""
        there = NAMES[AROUND] in [part.name for part in self.parts.parts]
        return self.parts.mask(NAMES[AROUND]) if there else torch.zeros(len(self.parts), dtype=torch.bool)

    def words(self) -> str:
        count = torch.bincount(self.parts.labels, minlength=len(self.parts.parts)).tolist()
        named = zip(self.parts.parts, count, strict=True)
        return ", ".join(f"{part.name} {part.role} ({number:,} Gaussians)" for part, number in named)

    def within(self, of: Tensor) -> FoundParts:
        """The same for a larger splat.

        Args:
            of: Which of its Gaussians these are, bool, shape (M,); the others are still.
        """
        parts = list(self.parts.parts)
        if NAMES[AROUND] not in [part.name for part in parts]:
            parts.append(Part(NAMES[AROUND], "still"))
        place = [part.name for part in parts].index(NAMES[AROUND])
        labels = torch.full((len(of),), place)
        labels[of] = self.parts.labels
        return replace(self, parts=Parts(labels, parts))


@dataclass(frozen=True)
class _Pot:
    """A surface of revolution: centre and radius at heights, and the height of its rim."""

    heights: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    rim: float

    def share(self, across: Tensor, height: Tensor) -> Tensor:
        """Distance from the axis as a share of the radius at that height, shape (N,)."""
        at = height.numpy()
        centre = np.stack([np.interp(at, self.heights, c) for c in self.centres.T], -1)
        return (across - torch.from_numpy(centre)).norm(dim=-1) / torch.from_numpy(
            np.interp(at, self.heights, self.radii)
        )


def plant_parts(cloud: GaussianCloud, simulated: Tensor, up: Sequence[float], weight: Tensor) -> FoundParts | None:
    """Find pot, soil, stems and leaves of a plant that stands in a pot.

    A pot is round about the up axis, at the lower end, and not green. It ends where the round wall ends, and most of
    what is above that is green. Soil is what lies level inside, and not green. Leaves are flat, stems are the rest.

    Args:
        cloud: The splat.
        simulated: The Gaussians of the object, bool, shape (N,).
        up: Up direction, a unit vector.
        weight: Visible area of each Gaussian, shape (N,).

    Returns:
        The parts: the pot is still, or held if no soil is seen in it; the soil is held, stems and leaves are soft, and
        everything else is still. None if there is no such pot.
    """
    index, means, axis = object_of(cloud, simulated, up)
    across, height = torch.stack([means @ a for a in plane_axes(axis)], -1), means @ axis
    low, high = quantile(height, 0.002), quantile(height, 0.998)
    if high <= low:
        return None
    height = (height - low) / (high - low)
    across = across / (high - low)
    visible, green = weight[index].double(), greenish(cloud.sh.detach()[index])
    pot = _find_pot(across, height, visible, green)
    if pot is None:
        return None
    above = height > pot.rim
    share = pot.share(across, height)
    in_pot, over, leafy = (float(visible[some].sum()) for some in (~above & (share < SAUCER), above, above & green))
    if over < PLANT * (in_pot + over) or leafy < LEAFY * over:
        return None
    soil, level = _find_soil(across, height, share, green, pot)
    label = torch.full((len(index),), STEM)
    below = height < pot.rim + 0.25 * LEVEL
    label[below & (share >= WALL) & (share < SAUCER) & ~green] = POT_LABEL
    label[(height < 2 / SLICES) & ~green & (share < SAUCER)] = POT_LABEL
    label[(height < 2 / SLICES) & ~green & (share >= SAUCER)] = AROUND
    if level is not None:
        label[soil] = SOIL
        label[below & (share < WALL) & (height < level - 3 * LEVEL)] = POT_LABEL  # under the surface
    else:
        label[below & (share < WALL) & ~green] = POT_LABEL
    near = height < pot.rim + 2 * LEVEL
    for _ in range(2):
        label[near] = _most_frequent(means[near], label[near])
    if level is not None:
        label[(label == SOIL) & (height < level - 5 * LEVEL)] = POT_LABEL
    plant = label == STEM
    piece = connected_parts(means[plant], 0.5 * NEAR * (high - low))
    top = torch.zeros(len(piece), dtype=torch.float64).scatter_reduce_(0, piece, height[plant], "amax")
    label[plant.nonzero()[:, 0][(top[piece] < pot.rim) & (share[plant] < SAUCER)]] = POT_LABEL  # spots on the wall
    plant = label == STEM
    if int(plant.sum()) < FEWEST:
        return None
    label[plant] = torch.where(woody(means[plant], green[plant], high - low), STEM, LEAF)
    role = {POT_LABEL: "held" if level is None else "still", SOIL: "held"}
    inside = "no soil is seen in it" if level is None else f"with soil at {level:.2f}"
    reason = f"a round wall up to {pot.rim:.2f} of the height, {inside}, and green above"
    parts = [Part(NAMES[k], role.get(k, "soft")) for k in range(AROUND)]
    return labelled(cloud, index, label, high - low, parts, reason)


def object_of(cloud: GaussianCloud, simulated: Tensor, up: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the Gaussians of an object, their centres, and the up direction, both float64."""
    index = simulated.nonzero()[:, 0]
    return index, cloud.means.detach()[index].double(), torch.tensor(list(up), dtype=torch.float64)


def greenish(sh: Tensor) -> Tensor:
    """True for Gaussians whose colour is green, bool, shape (N,).

    Args:
        sh: Coefficients, shape (N, K, 3).
    """
    red, green, blue = (0.5 + SH_DC * sh[:, 0].double()).clamp(0, 1).unbind(-1)
    return green - 0.5 * (red + blue) > GREEN * torch.stack([red, green, blue]).amax(0)


def _find_pot(across: Tensor, height: Tensor, weight: Tensor, green: Tensor) -> _Pot | None:
    """The pot at the lower end, from slice to slice upwards; None if there is none."""
    slices = (height * SLICES).floor().long()
    rings: list[tuple[float, np.ndarray, float]] = []
    missed = 0
    for k in range(-1, int(POT[1] * SLICES) + 2):
        own = ((slices == k) & ~green).nonzero()[:, 0]
        ring = _ring(across[own], weight[own]) if len(own) >= SECTORS else None
        if ring is not None and rings:
            centre, radius = rings[-1][1:]
            if np.linalg.norm(ring[0] - centre) > 0.25 * radius or not 0.75 < ring[1] / radius < 1.35:
                if len(rings) == 1:  # that was a floor or a saucer
                    rings.clear()
                else:
                    ring = None
        if ring is not None:
            rings.append(((k + 0.5) / SLICES, *ring))
            missed = 0
        elif rings:
            missed += 1
        if missed == 2 or (not rings and k > 3):
            break
    if len(rings) < 3:
        return None
    # soil or leaves may hide the wall of a slice: medians of five
    heights = np.array([height for height, _, _ in rings])
    around = [rings[max(0, k - 2) : k + 3] for k in range(len(rings))]
    centres = np.array([np.median([centre for _, centre, _ in some], axis=0) for some in around])
    radii = np.array([np.median([radius for _, _, radius in some]) for some in around])
    pot = _Pot(heights, centres, radii, 0.0)
    last = float(heights[-1])
    wall = (pot.share(across, height) - 1).abs() < ROUND
    near = wall & ~green & (height > last - 1 / SLICES) & (height < last + 1.5 / SLICES)
    rim = quantile(height[near], 0.95) if int(near.sum()) >= FEWEST else last + 0.5 / SLICES
    fits = POT[0] < rim < POT[1] and rim < SLENDER * float(np.median(radii))
    return _Pot(heights, centres, radii, rim) if fits else None


def _ring(points: Tensor, weight: Tensor) -> tuple[np.ndarray, float] | None:
    """Centre and radius of points around a circle, of which those inside do not count; None if it is none."""
    centre = (weight[:, None] * points).sum(0) / weight.sum().clamp(min=1e-30)
    outer = points
    for _ in range(3):
        arm = points - centre
        sector = ((torch.atan2(arm[:, 1], arm[:, 0]) / (2 * torch.pi) + 0.5) * SECTORS).long() % SECTORS
        radius = arm.norm(dim=-1)
        found = []
        for s in range(SECTORS):
            own = (sector == s).nonzero()[:, 0]
            if len(own):
                found.append(own[radius[own].argsort()[int(0.9 * (len(own) - 1))]])
        if len(found) < COVERED * SECTORS:
            return None
        outer = points[torch.stack(found)]
        # a circle by least squares: |x|² = 2 c·x + (r² - |c|²)
        system = torch.cat([2 * outer, torch.ones_like(outer[:, :1])], -1)
        solved = torch.linalg.lstsq(system, outer.square().sum(-1)[:, None]).solution[:, 0]
        centre = solved[:2]
    radii = (outer - centre).norm(dim=-1)
    if float(radii.std()) > ROUND * float(radii.mean()):
        return None
    return centre.numpy(), float(radii.mean())


def _find_soil(across: Tensor, height: Tensor, share: Tensor, green: Tensor, pot: _Pot) -> tuple[Tensor, float | None]:
    """The Gaussians of the soil, bool, shape (N,), and its mean height; None if too little of the opening shows it."""
    inside = (share < WALL) & ~green & (height < pot.rim + LEVEL) & (height > 0.3 * pot.rim)
    soil = torch.zeros_like(inside)
    if int(inside.sum()) < FEWEST:
        return soil, None
    bins = (height[inside] / (0.5 * LEVEL)).floor().long()
    mode = (float(bins.mode().values) + 0.5) * 0.5 * LEVEL
    system = torch.cat([across, torch.ones_like(height[:, None])], -1)
    plane = torch.tensor([0.0, 0.0, mode], dtype=torch.float64)
    for _ in range(4):
        close = inside & ((height - system @ plane).abs() < 2 * LEVEL)
        if int(close.sum()) < FEWEST:
            return soil, None
        plane = torch.linalg.lstsq(system[close], height[close][:, None]).solution[:, 0]
    above = height - system @ plane
    soil = inside & (above.abs() < 2 * LEVEL)
    soil |= (share < WALL) & (above < 0.5 * LEVEL) & (above > -2 * LEVEL)
    soil &= ~(green & (above > 0.5 * LEVEL))
    middle = soil & (share < OPENING)
    cells = equal_rows((across[middle] / (0.25 * float(pot.radii[-1]))).floor())
    opening = torch.pi * (OPENING / 0.25) ** 2
    level = float((system[close] @ plane).mean())
    return (soil, level) if cells.unique().numel() > INSIDE * opening else (torch.zeros_like(soil), None)


def _most_frequent(points: Tensor, label: Tensor) -> Tensor:
    """The most frequent label among the nearest neighbours of each point, which is one of them."""
    if len(points) <= NEIGHBOURS:
        return label
    near = nearest_neighbours(points, NEIGHBOURS)[1]
    votes = torch.nn.functional.one_hot(torch.cat([label[:, None], label[near]], -1), len(NAMES)).sum(1)
    return votes.argmax(-1)


def woody(points: Tensor, green: Tensor, size: float) -> Tensor:
    """True for stems, bool, shape (N,): not green, or, near by or farther around, longer than wide and not flat."""
    from scipy.spatial import cKDTree

    of_point = equal_rows((points / (CELL * size)).floor())
    count = sums(torch.ones_like(points[:, :1]), of_point)
    centre = sums(points, of_point) / count
    pairs = torch.from_numpy(cKDTree(centre.numpy()).query_pairs(NEAR * size, output_type="ndarray")).long()
    both = torch.cat([pairs, pairs.flip(1), torch.arange(len(centre))[:, None].expand(-1, 2)])
    first, second = both.unbind(1)
    stem = sums(green.double(), of_point) < 0.5 * count[:, 0]
    for reach in (NEAR, 0.5 * NEAR):
        close = (centre[first] - centre[second]).norm(dim=-1) < reach * size
        own, other = first[close], second[close]
        many = torch.bincount(own, minlength=len(centre)).double()
        mean = sums(centre[other], own, len(centre)) / many[:, None]
        arm = centre[other] - mean[own]
        covariance = sums(arm[:, :, None] * arm[:, None, :], own, len(centre)) / many[:, None, None]
        third, middle, main = torch.linalg.eigvalsh(covariance).unbind(-1)
        longer = (third > THIN * middle) & (middle < LONG * main) | (middle < THREAD * main)
        stem |= longer & (many >= SEEN)
    many = torch.bincount(first, minlength=len(centre))
    for _ in range(2):  # most of those around decide
        stem = sums(stem[second].double(), first, len(centre)) > 0.5 * many
    return stem[of_point]


def labelled(
    cloud: GaussianCloud, index: Tensor, label: Tensor, size: float, parts: list[Part], reason: str
) -> FoundParts:
    """The parts of a splat that have Gaussians.

    What is near the object, or faint and touches it, goes with it; others are around.

    Args:
        cloud: The splat.
        index: The Gaussians of the object, shape (M,).
        label: Their labels, shape (M,).
        size: Height of the object [scene units].
        parts: The parts of the object, by their labels; the next label is that of what is around it.
        reason: What was found, in words.
    """
    means, around = cloud.means.detach(), len(parts)
    labels = torch.full((len(means),), around)
    labels[index] = label
    rest = (labels == around).nonzero()[:, 0]
    if len(rest):
        distance, near = nearest_neighbours(means[index].double(), 1, means[rest].double())
        reach = torch.where(torch.sigmoid(cloud.opacities.detach()[rest]) < HAZE, TOUCHES, 0.0)
        reach = reach * cloud.scales.detach()[rest].exp().amax(-1)
        close = distance[:, 0] < NEAR * size + reach
        labels[rest[close]] = label[near[close, 0]]
    used, place = labels.unique(return_inverse=True)
    every = [*parts, Part(NAMES[AROUND], "still")]
    return FoundParts(Parts(place, [every[k] for k in used.tolist()]), reason)
