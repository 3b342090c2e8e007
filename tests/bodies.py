"""Bodies of Gaussians whose outer skin has a known area, as captures are: with layers, haze and clutter behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import GaussianSurfaceModel

CROWN = 0.33  # height of the lowest leaf of the ficus, above its pot [m]


@dataclass(frozen=True)
class Body:
    """Gaussians, and the area of what the wind can reach.

    Attributes:
        means: Centres [m], shape (N, 3), float64.
        normals: Unit normals, shape (N, 3).
        log_scales: Logarithm of the standard deviations [m], shape (N, 3).
        opacity: Opacities from 0 to 1, shape (N,).
        area: Area of the outer skin, one side of a free sheet [m²]; None for the area that ``coverage`` finds.
    """

    means: Tensor
    normals: Tensor
    log_scales: Tensor
    opacity: Tensor
    area: float | None

    def __add__(self, other: Body) -> Body:
        return Body(
            torch.cat([self.means, other.means]),
            torch.cat([self.normals, other.normals]),
            torch.cat([self.log_scales, other.log_scales]),
            torch.cat([self.opacity, other.opacity]),
            self.area,
        )

    def turned(self, rotation: Tensor, scale: float = 1.0, shift: float = 0.0) -> Body:
        """The body rotated (3, 3), enlarged and moved."""
        area = None if self.area is None else self.area * scale**2
        means = scale * self.means @ rotation.mT + shift
        return Body(means, self.normals @ rotation.mT, self.log_scales + math.log(scale), self.opacity, area)


def _random(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Numbers from the normal and from the uniform distribution, shape (count, 3) each."""
    generator = torch.Generator().manual_seed(seed)
    return (
        torch.randn(count, 3, generator=generator, dtype=torch.float64),
        torch.rand(count, 3, generator=generator, dtype=torch.float64),
    )


def _discs(means: Tensor, normals: Tensor, spacing: float, opacity: float, area: float | None) -> Body:
    """Flat discs with a standard deviation of half the spacing."""
    wide = math.log(0.5 * spacing)
    scales = means.new_tensor([wide, wide, wide - 3]).expand(len(means), 3)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return Body(means, normals, scales.contiguous(), means.new_full((len(means),), opacity), area)


def plate(count: int = 20_000, opacity: float = 0.95, seed: int = 0, roughness: float = 0.0) -> Body:
    noise, draw = _random(count, seed)
    place = draw * torch.tensor([1.0, 1.0, 0.0]) + noise * torch.tensor([0.0, 0.0, roughness * count**-0.5])
    return _discs(place, torch.tensor([[0.0, 0.0, 1.0]]).double().expand(count, 3), count**-0.5, opacity, 1.0)


def shell(count: int = 20_000, radius: float = 1.0, opacity: float = 0.95, seed: int = 0) -> Body:
    normal = torch.nn.functional.normalize(_random(count, seed)[0], dim=-1)
    area = 4 * math.pi * radius**2
    return _discs(radius * normal, normal, math.sqrt(area / count), opacity, area)


def clutter(count: int, spacing: float, opacity: float = 0.9, radius: float = 0.9, seed: int = 1) -> Body:
    normal, draw = _random(count, seed)
    away = torch.nn.functional.normalize(_random(count, seed + 1)[0], dim=-1) * radius * draw[:, :1] ** (1 / 3)
    return _discs(away, normal, spacing, opacity, None)


def cluttered_sphere(count: int = 40_000, opacity: float = 0.9, radius: float = 0.9) -> Body:
    half = count // 2
    return shell(half) + clutter(count - half, math.sqrt(4 * math.pi / half), opacity, radius)


def two_shells(count: int = 40_000, inner: float = 0.8) -> Body:
    return shell(count // 2) + shell(count - count // 2, inner, seed=3)


def cluttered_box(count: int = 40_000) -> Body:
    """A box of 1.0 x 0.8 x 0.6 m, and as many Gaussians of any direction two spacings below its faces and deeper."""
    half = torch.tensor([0.5, 0.4, 0.3], dtype=torch.float64)
    faces = half.prod() / half  # proportional to the areas
    skin = count // 2
    _, draw = _random(skin, 5)
    along = torch.linspace(0, 1, skin + 2, dtype=torch.float64)[1:-1]
    axis = torch.searchsorted((faces / faces.sum()).cumsum(0), along).clamp(0, 2)
    side = torch.where(torch.arange(skin) % 2 == 0, 1.0, -1.0).double()
    normal = torch.nn.functional.one_hot(axis, 3) * side[:, None]
    place = torch.where(normal != 0, normal, 2 * draw - 1) * half
    area = 8 * float(faces.sum())
    spacing = math.sqrt(area / skin)
    _, draw = _random(count - skin, 6)
    inside = _discs((2 * draw - 1) * (half - 2 * spacing), _random(count - skin, 7)[0], spacing, 0.9, None)
    return _discs(place, normal, spacing, 0.95, area) + inside


def layered_skin(layers: int = 4, gap: float = 1.0, opacity: float = 0.5, count: int = 15_000) -> Body:
    spacing = math.sqrt(4 * math.pi / count)
    found = shell(count, 1.0, opacity)
    for layer in range(1, layers):
        found = found + shell(count, 1 - layer * gap * spacing, opacity, seed=10 + layer)
    return found


def hazy_sphere(thickness: float = 5.0, opacity: float | None = None, count: int = 60_000, tilt: float = 0.3) -> Body:
    """A sphere whose Gaussians lie up to some spacings below its surface, are tilted, and differ in size and opacity.

    Units: ``thickness`` [spacings].
    """
    turn, draw = _random(count, 20)
    sizes, _ = _random(count, 21)
    body = shell(count, 1.0, 0.5 if opacity is None else opacity, seed=22)
    inwards = 1 - thickness * math.sqrt(4 * math.pi / count) * draw[:, :1]
    normals = torch.nn.functional.normalize(body.normals + tilt * turn, dim=-1)
    scales = body.log_scales + 0.4 * sizes[:, :1] + math.log(1.4)
    spread = 0.1 + 0.89 * draw[:, 1] if opacity is None else body.opacity
    return Body(body.means * inwards, normals, scales, spread, body.area)


def leaf_ball(index: float, side: float = 0.32, across: int = 12, seed: int = 40) -> Body:
    """Square leaves of any direction, spread evenly over a ball of radius 1 m.

    Units: ``side`` [m].
    """
    leaves = round(index * math.pi / side**2)
    turn, draw = _random(leaves, seed)
    away, helper = (torch.nn.functional.normalize(_random(leaves, seed + step)[0], dim=-1) for step in (1, 2))
    first = torch.nn.functional.normalize(turn, dim=-1)
    second = torch.nn.functional.normalize(torch.linalg.cross(first, helper), dim=-1)
    step = ((torch.arange(across, dtype=torch.float64) + 0.5) / across - 0.5) * side
    u, v = (part.reshape(1, -1, 1) for part in torch.meshgrid(step, step, indexing="ij"))
    means = (away * draw[:, :1] ** (1 / 3))[:, None] + u * first[:, None] + v * second[:, None]
    normals = torch.linalg.cross(first, second)[:, None].expand_as(means)
    return _discs(means.reshape(-1, 3), normals.reshape(-1, 3), side / across, 0.95, leaves * side**2)


def of_cloud(cloud: GaussianCloud, threshold: float = 0.1, above: float | None = None) -> Body:
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
    opacity = model.opacity()
    kept = opacity >= threshold
    if above is not None:
        kept &= model.means[:, 2] > above
    means, scales = (part.detach()[kept].double() for part in (model.means, model.scales))
    return Body(means, model.normals()[kept].double(), scales, opacity[kept].double(), None)
