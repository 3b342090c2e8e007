"""The kind of thing that a splat shows, and how things of that kind sway.

Frequencies, masses and damping are those of trees, plants and hanging things that were measured; what is an estimate is
marked in :data:`KINDS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gaussian_swaying.gaussians.measures import Array, Gaussians, breadth, corners, extent, slices_of
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.suggestion.parts import FoundParts


@dataclass(frozen=True)
class Kind:
    """A kind of thing, by how it sways.

    Attributes:
        words: Its name in a sentence.
        side: Usual length of its longest side [m], for a splat without a scale.
        frequency: First frequency in still air times the square root of the height [Hz sqrt(m)]; for ``hanging`` of the
            length from the pivot to the centre of mass, for ``rigid`` the frequency itself [Hz]. None for cloth, whose
            own numbers decide.
        mass: Mass per frontal area [kg/m²].
        drag: Drag coefficient of the whole on its frontal area.
        damping_ratio: Damping ratio in still air, without that of the air.
        material: The known material of its surface.
        other: The known material of its stems or wood, or of its cord.
        mass_by_height: Further mass per frontal area and height [kg/m³].
        leaf: First frequency of a leaf or twig on a stem that does not move [Hz], at least.
        slender: Height over the diameter at breast height of a conifer, whose girth decides its frequency.
        source: Where the numbers are from.
    """

    words: str
    side: float
    frequency: float | None
    mass: float
    drag: float
    damping_ratio: float
    material: str
    other: str = "wood"
    mass_by_height: float = 0.0
    leaf: float = 3.0
    slender: float | None = None
    source: str = "estimates"

    def first_frequency(self, height: float) -> float:
        """First frequency [Hz] at a height, or length, [m]; 0 for cloth."""
        if self.frequency is None or self is KINDS["rigid"]:
            return self.frequency or 0.0
        found = self.frequency / math.sqrt(height)
        return found if self.slender is None else min(GIRTH / (self.slender * height), found)

    def area_mass(self, height: float) -> float:
        """Mass per frontal area [kg/m²] at a height [m]."""
        return self.mass + self.mass_by_height * height

    @property
    def pivot(self) -> bool:
        """True for things with a stem, cord or ankles, which bend equally easily in both directions."""
        return not self.cloth and self is not KINDS["rigid"]

    @property
    def cloth(self) -> bool:
        return self.frequency is None


_TREES = "frequency: 844 trees of Jackson et al. 2021 (Biogeosciences 18:4059), k / sqrt(H); mass, drag: estimates"
_CONIFERS = f"{_TREES}; for conifers 386 dbh / H², and at most k of the stiffest tenth"
GIRTH = 386.0  # Hz m: frequency of a conifer times the square of its height over its diameter at breast height
KINDS = {
    "plant": Kind("a plant in a pot", 1.0, 1.4, 0.9, 0.58, 0.04, "leaf", "stem", source=_TREES),
    "succulent": Kind("a succulent", 0.3, 2.7, 8.0, 0.8, 0.03, "succulent", "stem", leaf=8.0),
    "grass": Kind("a tuft of grass", 0.5, 1.5, 0.5, 0.58, 0.06, "grass", "grass", source=_TREES),
    "shrub": Kind("a shrub", 1.2, 1.75, 2.0, 0.57, 0.04, "leaf", "twig", source=_TREES),
    "tree": Kind("a tree", 8.0, 1.55, 0.0, 0.45, 0.05, "leaf", "bark", 0.8, source=_TREES),
    "sapling": Kind("a young tree", 2.5, 1.6, 2.0, 0.48, 0.04, "leaf", "bark", source=_TREES),
    "conifer": Kind("a conifer", 8.0, 1.98, 0.0, 0.45, 0.04, "leaf", "bark", 0.8, slender=53.0, source=_CONIFERS),
    "hanging": Kind("a hanging thing", 1.0, 0.5, 12.0, 0.6, 0.02, "wood", source="a pendulum; mass, drag: estimates"),
    "cloth": Kind("a hanging cloth", 1.0, None, 0.2, 1.0, 0.02, "fabric", source="fabric of 0.2 kg/m²"),
    "flag": Kind("a flag", 1.0, None, 0.12, 1.0, 0.02, "fabric", source="nylon of 0.12 kg/m²"),
    "person": Kind("a person", 1.75, 1.3, 25.0, 1.0, 0.1, "clothes"),
    "rigid": Kind("a rigid thing", 1.0, 40.0, 8.0, 1.0, 0.02, "wood", source="no vibration below 10 Hz is seen"),
}
"""The kinds by name."""

STANDS_LOW = 0.6  # height of a succulent over its width, at most
LEAFY = 0.35  # green share of the visible area of a plant, at least
TALL = (1.8, 5.0)  # height of a person over its width
SKIN = 0.12  # share of the visible area of a head that has the colour of skin, at least
NARROW_TOP = 0.45  # width of a conifer in its upper quarter over that near its foot
SLENDER = 2.2  # height of a young tree over its width, at least
THREAD = 2.2  # length of the Gaussians of grass over their width, at least
STEM_E = 2e6  # Pa; of stems and wood, until their frequency is known


def kind_of(own: Gaussians, up: Array, end: str, sheet: bool, names: list[str], leaf: Gaussians) -> tuple[str, str]:
    """Guess the kind of a thing.

    Args:
        end: Where it is held: ``top``, ``bottom``, ``side`` or ``none``.
    """
    height, wide = own.means @ up, breadth(own.means, up, 0.02)
    low, high = corners(height)
    if "pot" in names:
        squat = extent(leaf.means @ up, 0.02) < STANDS_LOW * wide
        return ("succulent", "it stands in a pot, wider than high") if squat else ("plant", "it stands in a pot")
    if "pole" in names or (sheet and end == "side"):
        return "flag", "a sheet that is held at one side"
    if sheet or "cloth" in names:
        return "cloth", "a sheet"
    if end == "top":
        return "hanging", "it is held at its top"
    which = slices_of(height, 20)
    widths = [breadth(own.means[which == k], up, 0.05) if (which == k).sum() >= 8 else np.nan for k in range(20)]

    def mean_width(first: int, last: int) -> float:
        """Mean width of slices of a twentieth of the height."""
        own = np.array(widths[first:last])
        return float(np.nanmean(own)) if np.isfinite(own).any() else 0.0

    red, green, blue = own.colour.T
    leafy = np.average(own.green & (green > 0.97 * red), weights=own.weight + 1e-30)  # gold is no leaf
    if leafy > LEAFY or "leaf" in names:
        if mean_width(15, 20) < NARROW_TOP * mean_width(1, 5):
            return "conifer", "it is green, and narrow at the top"
        if "leaf" in names:
            young = high - low > SLENDER * wide
            return ("sapling" if young else "tree"), "a green crown on a bare trunk"
        thread = np.median(own.scales[:, 0] / own.scales[:, 1].clip(1e-30))
        if thread > THREAD and mean_width(0, 2) < 0.5 * wide and leafy > 0.8:
            return "grass", "thin and green, from one base"
        return "shrub", f"{leafy:.0%} of it is green"
    if end == "bottom" and TALL[0] < (high - low) / max(wide, 1e-30) < TALL[1]:
        head, bright = height > high - 0.16 * (high - low), red.clip(1e-6)
        skin = (green / bright > 0.55) & (green / bright < 0.9) & (blue / bright > 0.35) & (blue < green) & (red > 0.2)
        share = np.average(skin[head], weights=own.weight[head] + 1e-30)
        if share > SKIN and mean_width(18, 20) < 0.75 * mean_width(11, 16):
            return "person", f"{share:.0%} of its upper end has the colour of skin, above something wider"
    return "rigid", "neither green, nor a sheet, nor hanging: it stands, and there is little to sway"


def with_materials(found: FoundParts, kind: Kind, height: float) -> FoundParts:
    """The parts with densities, thicknesses and damping typical of the kind.

    Leaves and cloth have that of a sheet. Stems and wood are rods of which the surface is seen, so their thickness is
    half of a radius: 3 mm for a stem, and a 120th of the height for wood, branches included. They get twice the
    modulus, by which :mod:`~gaussian_swaying.suggestion.natural` tells them from leaves.

    Args:
        height: Its height [m].
    """

    def of(part: Part) -> Part:
        sheet = part.name in ("leaf", "head", "body")
        if part.role == "still" or not (sheet or part.name in ("stem", "wood", "foot", "post", "cord", "hook")):
            return part
        known = known_material(kind.material if sheet else kind.other)
        thickness = known.thickness if sheet else 0.0015 if part.name == "stem" else height / 240
        E = None if sheet or part.role == "rigid" else STEM_E
        return replace(part, density=known.density, thickness=thickness, damping_ratio=kind.damping_ratio, E=E)

    return replace(found, parts=Parts(found.parts.labels, [of(part) for part in found.parts.parts]))
