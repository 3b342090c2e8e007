"""Building blocks of the generated scenes: surfaces cut into flat patches, each of which becomes one Gaussian.

Shapes are made in float64, in metres, z up. Every patch knows its true normal and area.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.covariances import covariance_to_quat_scale

LIGHT = (-0.4, -0.7, 0.6)  # direction towards the light that is baked into the colours


@dataclass(frozen=True, slots=True)
class Patches:
    """Flat parallelograms.

    Attributes:
        center: Centres [m], shape (N, 3).
        across: One edge as a vector [m], shape (N, 3).
        along: The other [m], shape (N, 3). ``across`` x ``along`` points to the outside.
        colour: RGB in [0, 1], without light, shape (N, 3).
    """

    center: Tensor
    across: Tensor
    along: Tensor
    colour: Tensor

    def __len__(self) -> int:
        return self.center.shape[0]

    @property
    def area(self) -> Tensor:
        """Areas [m²], shape (N,)."""
        return torch.linalg.vector_norm(torch.linalg.cross(self.across, self.along), dim=-1)

    @property
    def normal(self) -> Tensor:
        """Unit normals, shape (N, 3)."""
        return torch.nn.functional.normalize(torch.linalg.cross(self.across, self.along), dim=-1, eps=1e-30)

    def mapped(self, matrix: Tensor | None = None, shift: Sequence[float] | Tensor = (0.0, 0.0, 0.0)) -> Patches:
        """The patches after a linear map (3, 3), which may stretch them, and a shift (3,)."""
        if matrix is None:
            matrix = torch.eye(3, dtype=torch.float64)
        move = torch.as_tensor(shift, dtype=torch.float64)
        center, across, along = (part @ matrix.mT for part in (self.center, self.across, self.along))
        return Patches(center + move, across, along, self.colour)

    def painted(self, colour: Sequence[float] | Tensor, where: Tensor | None = None) -> Patches:
        """The patches in one colour (3,) or in one colour each (N, 3); with ``where`` (N,) only the selected ones."""
        new = torch.as_tensor(colour, dtype=torch.float64).expand(len(self), 3)
        return replace(self, colour=new if where is None else torch.where(where[:, None], new, self.colour))


def join(parts: Sequence[Patches]) -> Patches:
    """All patches of several surfaces."""
    fields = ("center", "across", "along", "colour")
    return Patches(*(torch.cat([getattr(part, name) for part in parts]) for name in fields))


def baked(patches: Patches, ambient: float, two_sided: bool) -> Tensor:
    """Lit colours (N, 3): ``colour (ambient + (1 - ambient) max(0, n L))`` with :data:`LIGHT`."""
    light = torch.tensor(LIGHT, dtype=torch.float64)
    cosine = patches.normal @ (light / light.norm())
    lit = cosine.abs() if two_sided else cosine.clamp_min(0)
    return patches.colour * (ambient + (1 - ambient) * lit)[:, None]


def to_cloud(
    patches: Patches, overlap: float = 0.5, ambient: float = 0.45, two_sided: bool = True, opacity: float = 0.98
) -> GaussianCloud:
    """One Gaussian per patch.

    Args:
        overlap: Standard deviation of a Gaussian as a share of the edge of its patch.
        ambient: Share of ambient light in the baked light, in [0, 1].
        two_sided: Bake the same light into both sides, as for leaves and cloth.
        opacity: Opacity of every Gaussian, between 0 and 1.

    Returns:
        Gaussians with constant colours; ``normals`` are the true normals.
    """
    edges = torch.stack([patches.across, patches.along], dim=-1)
    longest = torch.linalg.vector_norm(edges, dim=-2).amax(-1)
    normal = patches.normal
    thin = 0.1 * patches.area / longest  # a tenth of the narrow side: the smallest axis is the normal
    covariance = overlap**2 * (edges @ edges.mT + (thin**2)[:, None, None] * normal[:, :, None] * normal[:, None, :])
    quats, scales = covariance_to_quat_scale(covariance)
    colour = baked(patches, ambient, two_sided).clamp(0, 1)
    return painted_cloud(patches.center, quats, scales, colour, opacity, normal)


def _coloured(center: Tensor, across: Tensor, along: Tensor, colour: Sequence[float]) -> Patches:
    paint = torch.tensor(colour, dtype=torch.float64).expand(center.shape)
    return Patches(*(part.reshape(-1, 3) for part in (center, across, along, paint)))


def steps(length: float, spacing: float, at_least: int = 1) -> int:
    """Number of patches along a length."""
    return max(at_least, round(length / spacing))


def quads(corners: Tensor, colour: Sequence[float] = (0.8, 0.8, 0.8)) -> Patches:
    """Patches from a lattice of corners.

    Args:
        corners: Corners [m], shape (R, 2, C + 1, 3): lower and upper edge of each row of C quadrilaterals.
        colour: RGB in [0, 1].
    """
    low, high = corners[:, 0], corners[:, 1]
    center = 0.25 * (low[:, 1:] + low[:, :-1] + high[:, 1:] + high[:, :-1])
    across = 0.5 * (low[:, 1:] - low[:, :-1] + high[:, 1:] - high[:, :-1])
    along = 0.5 * (high[:, 1:] + high[:, :-1] - low[:, 1:] - low[:, :-1])
    return _coloured(center, across, along, colour)


def sheet(
    surface: Callable[[Tensor, Tensor], Tensor], rows: int, columns: int, colour: Sequence[float] = (0.8, 0.8, 0.8)
) -> Patches:
    """A parametric surface.

    Args:
        surface: Point (..., 3) of v and u, both in [0, 1] of shape (...). The outside is on the side of du x dv.
        colour: RGB in [0, 1].
    """
    v = torch.linspace(0, 1, rows + 1, dtype=torch.float64)
    u = torch.linspace(0, 1, columns + 1, dtype=torch.float64)
    corners = surface(*torch.meshgrid(v, u, indexing="ij"))
    return quads(torch.stack([corners[:-1], corners[1:]], dim=1), colour)


def resample(path: Tensor, count: int) -> Tensor:
    """Points at equal distances along a polyline (K, D), ends included; shape (count, D)."""
    lengths = torch.linalg.vector_norm(path[1:, :3] - path[:-1, :3], dim=-1)
    at = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    wanted = torch.linspace(0, 1, count, dtype=path.dtype) * at[-1]
    index = torch.searchsorted(at, wanted, right=True).sub(1).clamp(0, len(path) - 2)
    share = (wanted - at[index]) / lengths[index].clamp_min(1e-12)
    return torch.lerp(path[index], path[index + 1], share[:, None])


def frames_along(path: Tensor) -> Tensor:
    """Axes (K, 3, 3) along a polyline (K, 3) that rotate as little as possible; columns: two normals, tangent."""
    tangent = torch.nn.functional.normalize(torch.gradient(path, dim=0)[0], dim=-1)
    helper = torch.nn.functional.one_hot(tangent[0].abs().argmin(), 3).to(path)
    first = torch.nn.functional.normalize(torch.linalg.cross(tangent[0], helper), dim=-1)
    normals = []
    for direction in tangent:
        first = torch.nn.functional.normalize(first - (first @ direction) * direction, dim=-1)
        normals.append(first)
    normal = torch.stack(normals)
    return torch.stack([normal, torch.linalg.cross(tangent, normal), tangent], dim=-1)


def tube(
    path: Sequence[Sequence[float]] | Tensor,
    radius: Sequence[float] | Tensor,
    spacing: float,
    colour: Sequence[float] = (0.4, 0.3, 0.2),
) -> Patches:
    """A round tube around a polyline, at least three patches per ring; the ends are open unless the radius is 0.

    Args:
        path: Points of the centre line [m], shape (K, 3).
        radius: Radius at these points [m], shape (K,).
        spacing: Distance between Gaussians [m].
        colour: RGB in [0, 1].
    """
    line = torch.as_tensor(path, dtype=torch.float64)
    line = torch.cat([line, torch.as_tensor(radius, dtype=torch.float64)[:, None]], dim=-1)
    length = float(torch.linalg.vector_norm(line[1:, :3] - line[:-1, :3], dim=-1).sum())
    rings = steps(length, spacing, 2)
    line = resample(line, rings + 1)
    count = steps(2 * math.pi * float(line[:, 3].mean()), spacing, 3)
    axes = frames_along(line[:, :3])
    axes = 0.5 * (axes[1:] + axes[:-1])
    angle = 2 * math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    spoke = angle.cos()[:, None] * axes[:, None, :, 0] + angle.sin()[:, None] * axes[:, None, :, 1]
    around = angle.cos()[:, None] * axes[:, None, :, 1] - angle.sin()[:, None] * axes[:, None, :, 0]
    low, high = (end[:, None, :3] + end[:, None, 3:] * spoke for end in (line[:-1], line[1:]))
    middle = 0.5 * (line[1:, 3] + line[:-1, 3])[:, None, None]
    return _coloured(0.5 * (low + high), (2 * math.pi / count) * middle * around, high - low, colour)


def revolution(
    profile: Sequence[Sequence[float]] | Tensor, spacing: float, colour: Sequence[float] = (0.8, 0.8, 0.8)
) -> Patches:
    """A solid of revolution about z: the surface that a profile sweeps.

    Args:
        profile: Radius and height [m], shape (K, 2). The outside is to the right of the direction of the profile.
        spacing: Distance between Gaussians [m].
        colour: RGB in [0, 1].
    """
    line = torch.as_tensor(profile, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(line[1:] - line[:-1], dim=-1).sum())
    line = resample(line, steps(length, spacing, 2) + 1)
    rings = []
    for low, high in pairwise(line):
        radius, height = (0.5 * (low + high)).tolist()
        count = steps(2 * math.pi * radius, spacing, 3)
        angle = 2 * math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count
        nil = torch.zeros_like(angle)
        spoke = torch.stack([angle.cos(), angle.sin(), nil], dim=-1)
        around = torch.stack([-angle.sin(), angle.cos(), nil], dim=-1)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        outwards, upwards = (high - low).tolist()
        across = (2 * math.pi * radius / count) * around
        rings.append(_coloured(radius * spoke + height * up, across, outwards * spoke + upwards * up, colour))
    return join(rings)


def ellipsoid(
    center: Sequence[float], radii: Sequence[float], spacing: float, colour: Sequence[float] = (0.8, 0.8, 0.8)
) -> Patches:
    """An ellipsoid with axes along x, y and z; ``spacing`` is that of its longest axis."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 129, dtype=torch.float64)
    unit = revolution(torch.stack([angle.cos(), angle.sin()], dim=-1), spacing / max(radii), colour)
    return unit.mapped(torch.tensor(radii, dtype=torch.float64).diag(), center)


def disc(center: Sequence[float], radius: float, spacing: float, colour: Sequence[float] = (0.8, 0.8, 0.8)) -> Patches:
    """A flat disc that faces up."""
    return revolution([[radius, 0.0], [0.0, 0.0]], spacing, colour).mapped(shift=center)


def box(
    low: Sequence[float], high: Sequence[float], spacing: float, colour: Sequence[float] = (0.8, 0.8, 0.8)
) -> Patches:
    """The six faces of a box with sides along the axes, between two corners [m]."""
    corner = torch.tensor(low, dtype=torch.float64)
    side = torch.tensor(high, dtype=torch.float64) - corner
    faces = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        rows, columns = steps(float(side[j]), spacing), steps(float(side[i]), spacing)
        for end in (0, 1):

            def face(v: Tensor, u: Tensor, axis: int = axis, i: int = i, j: int = j, end: int = end) -> Tensor:
                point = corner.expand(*v.shape, 3).clone()
                point[..., axis] += end * side[axis]
                point[..., i] += (u if end else 1 - u) * side[i]
                point[..., j] += v * side[j]
                return point

            faces.append(sheet(face, rows, columns, colour))
    return join(faces)


def copies(template: Patches, axes: Tensor, size: Tensor, origin: Tensor, tint: Tensor) -> Patches:
    """One template placed many times.

    Args:
        axes: Rotation of each copy, shape (M, 3, 3).
        size: Factor on its lengths, shape (M,).
        origin: Position of each copy's origin [m], shape (M, 3).
        tint: Factor on its colours, shape (M, 3).
    """
    turn = axes * size[:, None, None]

    def placed(part: Tensor) -> Tensor:
        return torch.einsum("mij,tj->mti", turn, part)

    center = placed(template.center) + origin[:, None]
    colour = template.colour * tint[:, None]
    return Patches(
        center.reshape(-1, 3),
        placed(template.across).reshape(-1, 3),
        placed(template.along).reshape(-1, 3),
        colour.reshape(-1, 3),
    )


def facing(direction: Tensor, up: Tensor) -> Tensor:
    """Rotations (M, 3, 3) that take y to a direction (M, 3), with z as close to ``up`` (M, 3) as possible."""
    y = torch.nn.functional.normalize(direction, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(y, up), dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def painted_cloud(
    means: Tensor, quats: Tensor, scales: Tensor, colours: Tensor, opacity: float, normals: Tensor | None = None
) -> GaussianCloud:
    """Gaussians with one colour each, from 0 to 1, and one opacity for all; the rest as in a GaussianCloud."""
    return GaussianCloud(
        means=means.float(),
        quats=quats.float(),
        scales=scales.float().contiguous(),
        opacities=torch.full((len(means),), math.log(opacity / (1 - opacity))),
        sh=((colours - 0.5) / SH_DC).float()[:, None, :],
        normals=None if normals is None else normals.float(),
    )
