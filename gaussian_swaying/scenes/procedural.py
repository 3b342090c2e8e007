"""Splats generated in code, so that everything runs without downloads."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.gaussians.cloud import GaussianCloud, joined
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.scenes.flag_stands import Stand, stand_patches
from gaussian_swaying.scenes.patches import join, painted_cloud, to_cloud
from gaussian_swaying.scenes.printed_cloth import printed_colours

_MOST = 50_000_000  # Gaussians, about 100 GB


class ProceduralScene(Fixed, ABC):
    """Base of all generated scenes."""

    live_as = "generator"

    @abstractmethod
    def generate(self) -> GaussianCloud:
        """Make the splat; the same arguments give the same splat."""

    def check(self, *positive: str) -> None:
        """Raise ValueError unless ``spacing`` and the named numbers are positive."""
        for name in ("spacing", *positive):
            check_positive(f"generator.{name}", getattr(self, name))


def both(first: GaussianCloud, second: GaussianCloud) -> GaussianCloud:
    """Two splats joined, with both normals."""
    parts = [
        replace(part, normals=smallest_axis_normal(part.quats, part.scales)) if part.normals is None else part
        for part in (first, second)
    ]
    return joined(*parts)


@dataclass(eq=False)
class GivenScene(ProceduralScene):
    """Wraps Gaussians already in memory; a YAML names a file instead.

    Args:
        cloud: The Gaussians.
    """

    cloud: GaussianCloud

    def generate(self) -> GaussianCloud:
        return self.cloud


@dataclass(eq=False)
class FlagScene(ProceduralScene):
    """A rectangular flag in the x-z plane with its pole side at x = 0 and its lower edge at z = 0, in metres.

    One layer of disc-shaped Gaussians on a square lattice with a small ripple, so that a flag at rest is not exactly
    edge-on to a wind along x.

    Args:
        width: Length along x [m].
        height: Length along z [m].
        spacing: Distance between Gaussians [m].
        overlap: Standard deviation of a Gaussian as a share of the spacing.
        ripple: Amplitude of the ripple along y [m]. A few millimetres change what a light flag does: held along x, its
            edge is not straight, and cannot turn without strain. Compare only flags with the same ripple.
        pattern: ``stripes`` (three bands of colour and a disc), ``white``, or ``printed``, with features everywhere
            (see :func:`~gaussian_swaying.scenes.printed_cloth.printed_colours`).
        yaw: Angle by which flag and stand are turned about the pole side, counter-clockwise seen from above [degrees].
        stand: Shows where the flag is held, outside its box [0, width] x [-0.005, 0.005] x [0, height] before it is
            turned, so that ``scene.region`` can be that box: ``pole`` along the left edge, ``posts`` with clips at all
            corners but the lower left, or ``rod`` along the top edge, on ropes.
    """

    width: float = 1.2
    height: float = 0.8
    spacing: float = 0.0125
    overlap: float = 0.6
    ripple: float = 0.003
    pattern: Literal["stripes", "white", "printed"] = "stripes"
    yaw: float = 0.0
    stand: Stand = "none"

    def __post_init__(self) -> None:
        self.check("width", "height", "overlap")
        check_positive("generator.ripple", self.ripple, allow_zero=True)
        if self.spacing > min(self.width, self.height):
            raise ValueError(f"Expected `generator.spacing` below the flag's sides, but got {self.spacing} m.")
        if not self.width / self.spacing * self.height / self.spacing <= _MOST:
            raise ValueError(
                f"Expected `generator.spacing` that makes at most {_MOST:,} Gaussians, but got {self.spacing} m."
            )
        if not math.isfinite(self.yaw):
            raise ValueError(f"Expected `generator.yaw` to be a finite angle in degrees, but got {self.yaw}.")

    def generate(self) -> GaussianCloud:
        """Make the flag, and then its stand."""
        h = self.spacing
        columns, rows = round(self.width / h), round(self.height / h)
        u = (torch.arange(columns, dtype=torch.float64) + 0.5) * h
        v = (torch.arange(rows, dtype=torch.float64) + 0.5) * h
        x, z = (g.reshape(-1) for g in torch.meshgrid(u, v, indexing="ij"))
        wave = 2 * math.pi * 1.5 / self.width
        y = self.ripple * torch.sin(wave * x)
        turn = math.radians(self.yaw)
        turned_x, turned_y = math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y
        means = torch.stack([turned_x, turned_y, z], dim=-1)
        # the smallest axis is the local z of the Gaussian; turn it onto the normal (-y', 1, 0) of the rippled sheet:
        # first by -90 degrees about x, then by the angle of the slope, and that of the flag, about z
        yaw = torch.atan(self.ripple * wave * torch.cos(wave * x)) + turn
        cosine, sine = torch.cos(yaw / 2), torch.sin(yaw / 2)
        quats = math.sqrt(0.5) * torch.stack([cosine, -cosine, -sine, sine], dim=-1)
        sigma = self.overlap * h
        scales = torch.tensor([sigma, sigma, 0.1 * sigma], dtype=torch.float64).log().expand(len(x), 3)
        flag = painted_cloud(means, quats, scales, self._colours(x, z), 0.99)
        if self.stand == "none":
            return flag
        matrix = torch.tensor(
            [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]],
            dtype=torch.float64,
        )
        parts = stand_patches(self.stand, self.width, self.height, min(h, 0.02))
        return both(flag, to_cloud(join(parts).mapped(matrix), two_sided=False))

    def _colours(self, x: Tensor, z: Tensor) -> Tensor:
        if self.pattern == "white":
            return torch.full((len(x), 3), 0.9, dtype=torch.float64)
        if self.pattern == "printed":
            return printed_colours(x, z)
        bands = torch.tensor([[0.83, 0.30, 0.18], [0.95, 0.92, 0.85], [0.13, 0.33, 0.55]], dtype=torch.float64)
        colours = bands[0].repeat(len(x), 1)
        for k in (1, 2):
            colours = self._inside(colours, bands[k], self.height * (1 - k / 3) - z)
        disc = 0.2 * self.height - torch.hypot(x - 0.5 * self.width, z - 0.5 * self.height)
        return self._inside(colours, torch.tensor([0.93, 0.68, 0.20], dtype=torch.float64), disc)

    def _inside(self, colours: Tensor, other: Tensor, depth: Tensor) -> Tensor:
        """Another colour up to an edge, which is as wide as the spacing, so that it shows no steps."""
        return torch.lerp(colours, other, (0.5 + depth / self.spacing).clamp(0, 1)[:, None])
