"""Stands of the flag, so that its pins are visible."""

from __future__ import annotations

from typing import Literal

from gaussian_swaying.scenes.patches import Patches, ellipsoid, tube

METAL, GOLD, CLOTH, ROPE = (0.62, 0.64, 0.67), (0.90, 0.68, 0.22), (0.86, 0.86, 0.84), (0.72, 0.60, 0.42)
Stand = Literal["none", "pole", "posts", "rod"]


def stand_patches(kind: Stand, width: float, height: float, step: float) -> list[Patches]:
    """The stand of a flag that is not turned.

    Args:
        kind: As in :class:`~gaussian_swaying.scenes.procedural.FlagScene`, but for ``none``.
        width: Length of the flag along x [m].
        height: Length along z [m].
        step: Largest distance between Gaussians [m].
    """

    def bar(start: tuple[float, ...], end: tuple[float, ...], radius: float, colour: tuple[float, ...]) -> Patches:
        return tube([list(start), list(end)], [radius, radius], min(step, 0.8 * radius), colour)

    def ball(center: tuple[float, ...], radii: tuple[float, ...]) -> Patches:
        return ellipsoid(center, radii, min(step, 0.5 * max(radii)), GOLD)

    if kind == "pole":  # down out of the picture, with the hem of the flag around it
        pole = bar((-0.024, 0.0, -2.0 * height), (-0.024, 0.0, 1.06 * height), 0.016, METAL)
        hem = bar((-0.024, 0.0, 0.0), (-0.024, 0.0, height), 0.021, CLOTH)
        return [pole, hem, ball((-0.024, 0.0, 1.06 * height + 0.03), (0.034, 0.034, 0.034))]
    parts = []
    if kind == "rod":
        level = height + 0.025
        parts.append(bar((-0.08, 0.0, level), (width + 0.08, 0.0, level), 0.016, METAL))
        for x in (-0.08, width + 0.08):
            parts.append(ball((x, 0.0, level), (0.024, 0.024, 0.024)))
        for x in (0.12 * width, 0.88 * width):
            parts.append(bar((x, 0.0, level), (x, 0.0, level + height), 0.007, ROPE))
        return parts
    for x, corners in ((-0.07, (height,)), (width + 0.07, (0.0, height))):
        parts.append(bar((x, 0.0, -2.0 * height), (x, 0.0, 1.08 * height), 0.016, METAL))
        parts.append(ball((x, 0.0, 1.08 * height + 0.02), (0.028, 0.028, 0.028)))
        inwards = 0.02 if x < 0 else -0.02
        edge = 0.0 if x < 0 else width
        for z in corners:
            level = abs(z - 0.02)
            for y in (-0.016, 0.016):  # in front of the cloth and behind it
                parts.append(ball((edge + inwards, y, level), (0.026, 0.009, 0.026)))
                parts.append(bar((x, y, level), (edge + inwards, y, level), 0.006, GOLD))
    return parts
