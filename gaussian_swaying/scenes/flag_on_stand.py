"""A flag and its stand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, ellipsoid, join, to_cloud, tube
from gaussian_swaying.scenes.procedural import FlagScene, ProceduralScene, both

METAL, GOLD, CLOTH, ROPE = (0.62, 0.64, 0.67), (0.90, 0.68, 0.22), (0.86, 0.86, 0.84), (0.72, 0.60, 0.42)


@dataclass(eq=False)
class FlagOnStandScene(ProceduralScene):
    """A :class:`~gaussian_swaying.scenes.procedural.FlagScene` with a stand, so that its pins are visible.

    The stand is outside the box of the flag, [0, width] x [-0.005, 0.005] x [0, height] before it is turned. A
    configuration sets this box as ``scene.region`` so that only the flag moves.

    Args:
        width: Length of the flag along x [m].
        height: Length along z [m].
        spacing: Distance between Gaussians of the flag [m]; on the stand at most 2 cm.
        pattern: Of the flag, as there.
        overlap: Of the flag, as there.
        yaw: Angle by which flag and stand are turned about the pole side, counter-clockwise seen from above [degrees].
        stand: ``pole`` along the left edge, ``posts`` with clips at all corners but the lower left, ``rod`` along the
            top edge, on ropes, or ``none``.
    """

    width: float = 1.2
    height: float = 0.8
    spacing: float = 0.0125
    pattern: Literal["stripes", "white", "printed"] = "stripes"
    overlap: float = 0.6
    yaw: float = 0.0
    stand: Literal["pole", "posts", "rod", "none"] = "pole"

    def __post_init__(self) -> None:
        self.check()
        self.flag = FlagScene(self.width, self.height, self.spacing, self.overlap, pattern=self.pattern, yaw=self.yaw)

    def generate(self) -> GaussianCloud:
        """Make both; the flag comes first."""
        flag = self.flag.generate()
        if self.stand == "none":
            return flag
        turn = math.radians(self.flag.yaw)
        matrix = torch.tensor(
            [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]],
            dtype=torch.float64,
        )
        parts = {"pole": self._pole, "posts": self._posts, "rod": self._rod}[self.stand]()
        stand = to_cloud(join(parts).mapped(matrix), two_sided=False)
        return both(flag, stand)

    @property
    def _step(self) -> float:
        return min(self.flag.spacing, 0.02)

    def _bar(
        self, start: tuple[float, ...], end: tuple[float, ...], radius: float, colour: tuple[float, ...]
    ) -> Patches:
        return tube([list(start), list(end)], [radius, radius], min(self._step, 0.8 * radius), colour)

    def _ball(self, center: tuple[float, ...], radii: tuple[float, ...]) -> Patches:
        return ellipsoid(center, radii, min(self._step, 0.5 * max(radii)), GOLD)

    def _pole(self) -> list[Patches]:
        """A pole that continues down out of the picture, with the hem of the flag around it."""
        height = self.flag.height
        pole = self._bar((-0.024, 0.0, -2.0 * height), (-0.024, 0.0, 1.06 * height), 0.016, METAL)
        hem = self._bar((-0.024, 0.0, 0.0), (-0.024, 0.0, height), 0.021, CLOTH)
        return [pole, hem, self._ball((-0.024, 0.0, 1.06 * height + 0.03), (0.034, 0.034, 0.034))]

    def _posts(self) -> list[Patches]:
        width, height = self.flag.width, self.flag.height
        parts = []
        for x, corners in ((-0.07, (height,)), (width + 0.07, (0.0, height))):
            parts.append(self._bar((x, 0.0, -2.0 * height), (x, 0.0, 1.08 * height), 0.016, METAL))
            parts.append(self._ball((x, 0.0, 1.08 * height + 0.02), (0.028, 0.028, 0.028)))
            inwards = 0.02 if x < 0 else -0.02
            edge = 0.0 if x < 0 else width
            for z in corners:
                level = abs(z - 0.02)
                for y in (-0.016, 0.016):  # in front of the cloth and behind it
                    parts.append(self._ball((edge + inwards, y, level), (0.026, 0.009, 0.026)))
                    parts.append(self._bar((x, y, level), (edge + inwards, y, level), 0.006, GOLD))
        return parts

    def _rod(self) -> list[Patches]:
        width, level = self.flag.width, self.flag.height + 0.025
        parts = [self._bar((-0.08, 0.0, level), (width + 0.08, 0.0, level), 0.016, METAL)]
        for x in (-0.08, width + 0.08):
            parts.append(self._ball((x, 0.0, level), (0.024, 0.024, 0.024)))
        for x in (0.12 * width, 0.88 * width):
            parts.append(self._bar((x, 0.0, level), (x, 0.0, level + self.flag.height), 0.007, ROPE))
        return parts
