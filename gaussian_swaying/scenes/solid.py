"""Solids generated in code: Gaussians on the surface of a body, and optionally inside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import painted_cloud
from gaussian_swaying.scenes.procedural import ProceduralScene

# balls (x, y, z, radius) of the figure, for a height of 1: body, head, muzzle, ears, arms, legs; it looks along -y
FIGURE = (
    (0.00, 0.00, 0.27, 0.27),
    (0.00, -0.02, 0.68, 0.21),
    (0.00, -0.20, 0.64, 0.08),
    (-0.16, 0.00, 0.86, 0.09),
    (0.16, 0.00, 0.86, 0.09),
    (-0.25, -0.12, 0.40, 0.10),
    (0.25, -0.12, 0.40, 0.10),
    (-0.18, -0.26, 0.10, 0.12),
    (0.18, -0.26, 0.10, 0.12),
)
_OVERLAP = 0.6  # standard deviation of a Gaussian, per spacing
_JITTER = 0.3  # largest random shift of points of the lattice, per spacing
_BLEND = 0.02  # radius over which the balls of the figure blend into each other, for a height of 1


def ball_distance(points: Tensor, radius: float) -> Tensor:
    """Signed distance to a ball about the origin, negative inside; points (..., 3), result (...)."""
    return torch.linalg.vector_norm(points, dim=-1) - radius


def box_distance(points: Tensor, half: tuple[float, float, float]) -> Tensor:
    """Signed distance to a box about the origin with half sides ``half``, as :func:`ball_distance`."""
    beyond = points.abs() - torch.tensor(half, dtype=points.dtype)
    return torch.linalg.vector_norm(beyond.clamp_min(0), dim=-1) + beyond.amax(-1).clamp_max(0)


def torus_distance(points: Tensor, ring: float, tube: float) -> Tensor:
    """Signed distance to a torus about z, its tube of radius ``tube`` on a ring, as :func:`ball_distance`."""
    across = torch.linalg.vector_norm(points[..., :2], dim=-1) - ring
    return torch.hypot(across, points[..., 2]) - tube


def figure_distance(points: Tensor, height: float) -> Tensor:
    """Approximate signed distance to a seated bear on the plane z = 0, as :func:`ball_distance`."""
    balls = torch.tensor(FIGURE, dtype=points.dtype) * height
    each = torch.linalg.vector_norm(points[..., None, :] - balls[:, :3], dim=-1) - balls[:, 3]
    blend = _BLEND * height
    return torch.maximum(-blend * torch.logsumexp(-each / blend, dim=-1), -points[..., 2])


@dataclass(eq=False)
class SolidScene(ProceduralScene):
    """A solid body with flat Gaussians on its surface, their shortest axes along the true normals, z up.

    The Gaussians on the surface are the nearby points of a jittered lattice, moved onto it. The Gaussians inside, if
    wanted, are the other points of the lattice, with the same size and the normals of the nearest surface.

    Args:
        shape: ``figure`` (a seated bear), ``ball``, ``box`` (2 : 1.6 : 1.2) or ``torus`` (tube of 0.3 of the ring).
        size: Height of the figure, diameter of the ball, longest side of the box, outer diameter of the torus [m].
        spacing: Distance between Gaussians [m], at most a quarter of the size.
        gaussians: ``throughout``, or ``shell`` for a hollow splat, as captures are.
    """

    shape: Literal["figure", "ball", "box", "torus"] = "figure"
    size: float = 1.0
    spacing: float = 0.02
    gaussians: Literal["throughout", "shell"] = "throughout"

    def __post_init__(self) -> None:
        self.check("size")
        if self.spacing > 0.25 * self.size:
            raise ValueError(
                f"Expected `generator.spacing` to be at most a quarter of the size, but got {self.spacing} m."
            )

    @property
    def distance(self) -> Callable[[Tensor], Tensor]:
        """Signed distance [m] of points (..., 3) [m] to the surface, negative inside."""
        half = 0.5 * self.size
        if self.shape == "ball":
            return lambda points: ball_distance(points, half)
        if self.shape == "box":
            return lambda points: box_distance(points, (half, 0.8 * half, 0.6 * half))
        if self.shape == "torus":
            return lambda points: torus_distance(points, half / 1.3, 0.3 * half / 1.3)
        return lambda points: figure_distance(points, self.size)

    def generate(self) -> GaussianCloud:
        h, draw = self.spacing, torch.Generator().manual_seed(0)
        reach = 0.5 * self.size + h
        steps = torch.arange(-reach, reach + h, h, dtype=torch.float64)
        points = torch.cartesian_prod(steps, steps, steps)
        if self.shape == "figure":
            points[:, 2] += 0.5 * self.size
        points += _JITTER * h * (torch.rand(points.shape, generator=draw, dtype=torch.float64) - 0.5)
        distance = self.distance(points)
        skin = points[distance.abs() < 0.5 * h]
        for _ in range(8):  # onto the surface; for a true distance and away from edges once is enough
            skin = skin - self.distance(skin)[:, None] * self.normal(skin)
        means, normals = skin, self.normal(skin)
        if self.gaussians == "throughout":
            core = points[distance <= -0.5 * h]
            means, normals = torch.cat([skin, core]), torch.cat([normals, self.normal(core)])
        sigma = _OVERLAP * h
        scales = torch.tensor([sigma, sigma, 0.1 * sigma], dtype=torch.float64).log().expand(len(means), 3)
        shade = 1 + 0.06 * torch.randn(len(means), 1, generator=draw, dtype=torch.float64)
        colours = torch.tensor([0.86, 0.70, 0.46], dtype=torch.float64) * shade
        return painted_cloud(means, _quat_from_z(normals), scales, colours, 0.99, normals)

    def normal(self, points: Tensor) -> Tensor:
        """Unit gradient of the distance at points (N, 3), by central differences; +z where it is zero."""
        step = 1e-6 * self.size
        offsets = step * torch.eye(3, dtype=torch.float64)
        slope = [self.distance(points + offset) - self.distance(points - offset) for offset in offsets]
        gradient = torch.stack(slope, dim=-1) / (2 * step)
        length = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return torch.where(length > 0.1, gradient / length.clamp_min(1e-12), up)


def _quat_from_z(normals: Tensor) -> Tensor:
    """Quaternions wxyz (N, 4) of the smallest rotations that take +z to unit vectors (N, 3); about x for -z."""
    x, y, z = normals.unbind(-1)
    quats = torch.stack([1 + z, -y, x, torch.zeros_like(x)], dim=-1)
    flip = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=normals.dtype)
    return torch.nn.functional.normalize(torch.where(z[:, None] < -1 + 1e-9, flip, quats), dim=-1)
