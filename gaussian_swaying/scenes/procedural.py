"""Splats generated in code, so that everything runs without downloads."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.scenes.printed_cloth import printed_colours

_MOST = 50_000_000  # Gaussians, about 100 GB


class ProceduralScene(ABC):
    """Base of all generated scenes."""

    @abstractmethod
    def generate(self) -> GaussianCloud:
        """Make the splat; the same arguments give the same splat."""


class GivenScene(ProceduralScene):
    """Gaussians that are there already, for Python: a YAML names a file.

    Args:
        cloud: The Gaussians.
    """

    def __init__(self, cloud: GaussianCloud) -> None:
        self.cloud = cloud

    def generate(self) -> GaussianCloud:
        """The Gaussians, as they are."""
        return self.cloud


class FlagScene(ProceduralScene):
    """A rectangular flag in the x-z plane with its pole side at x = 0 and its lower edge at z = 0, in metres.

    One layer of disc-shaped Gaussians on a square lattice with a small ripple, so that a flag at rest is not exactly
    edge-on to a wind along x.

    Args:
        width: Length along x [m].
        height: Length along z [m].
        spacing: Distance between Gaussians [m].
        overlap: Standard deviation of a Gaussian as a share of the spacing.
        ripple: Amplitude of the ripple along y [m].
        pattern: ``stripes`` (three bands of colour and a disc), ``white``, or ``printed``, with features everywhere
            (see :func:`~gaussian_swaying.scenes.printed_cloth.printed_colours`).
        yaw: Angle by which the flag is turned about its pole side, counter-clockwise seen from above [degrees].
    """

    def __init__(
        self,
        width: float = 1.2,
        height: float = 0.8,
        spacing: float = 0.0125,
        overlap: float = 0.6,
        ripple: float = 0.003,
        pattern: str = "stripes",
        yaw: float = 0.0,
    ) -> None:
        for name, value in (("width", width), ("height", height), ("spacing", spacing), ("overlap", overlap)):
            check_positive(f"generator.{name}", value)
        check_positive("generator.ripple", ripple, allow_zero=True)
        check_choice("generator.pattern", pattern, ("stripes", "white", "printed"))
        if spacing > min(width, height):
            raise ValueError(f"Expected `generator.spacing` below the flag's sides, but got {spacing} m.")
        count = width / spacing * height / spacing
        if not count <= _MOST:
            raise ValueError(
                f"Expected `generator.spacing` that makes at most {_MOST:,} Gaussians, but got {spacing} m."
            )
        self.width, self.height, self.spacing = float(width), float(height), float(spacing)
        self.overlap, self.ripple, self.pattern = float(overlap), float(ripple), pattern
        if not math.isfinite(yaw):
            raise ValueError(f"Expected `generator.yaw` to be a finite angle in degrees, but got {yaw}.")
        self.yaw = float(yaw)

    def generate(self) -> GaussianCloud:
        """Make the flag."""
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
        return GaussianCloud(
            means=means.float(),
            quats=quats.float(),
            scales=scales.float().contiguous(),
            opacities=torch.full((len(x),), math.log(0.99 / 0.01)),
            sh=((self._colours(x, z) - 0.5) / SH_DC).float()[:, None, :],
            normals=None,
        )

    def _colours(self, x: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        if self.pattern == "white":
            return torch.full((len(x), 3), 0.9, dtype=torch.float64)
        if self.pattern == "printed":
            return printed_colours(x, z)
        bands = torch.tensor([[0.83, 0.30, 0.18], [0.95, 0.92, 0.85], [0.13, 0.33, 0.55]], dtype=torch.float64)
        band = ((1 - z / self.height) * 3).long().clamp(0, 2)
        colours = bands[band].clone()
        distance = torch.hypot(x - 0.5 * self.width, z - 0.5 * self.height)
        colours[distance < 0.2 * self.height] = torch.tensor([0.93, 0.68, 0.20], dtype=torch.float64)
        return colours
