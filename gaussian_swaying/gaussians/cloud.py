"""3D Gaussians in storage form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape, check_vector
from gaussian_swaying._fixed import fixed
from gaussian_swaying.gaussians.harmonics import sh_degree
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin, origin_of


@fixed
@dataclass(frozen=True, slots=True)
class GaussianCloud:
    """3D Gaussians in storage form, as a 3DGS .ply file stores them.

    Attributes:
        means: Centres [scene units], shape (N, 3).
        quats: Rotations as quaternions wxyz, not normalised, shape (N, 4).
        scales: Natural logarithm of the standard deviations [scene units] along the axes, shape (N, 3).
        opacities: Logit of the opacity, shape (N,).
        sh: Spherical harmonics coefficients of the colour, constant first, shape (N, K, 3) with K = 1, 4, 9 or 16.
        normals: Surface normals stored with the Gaussians, shape (N, 3), or None.
        origin: The point of the file that the centres count from, in float64: zero unless its coordinates are far from
            zero (see :func:`~gaussian_swaying.geometry.origin.origin_of`). Writers put it back.

    Raises:
        ValueError: If a tensor does not have the shape above.
        TypeError: If one is not a tensor.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    normals: Tensor | None = None
    origin: Origin = NO_ORIGIN

    def __post_init__(self) -> None:
        check_shape("means", self.means, None, 3, batches=False)
        count = self.means.shape[0]
        sizes: dict[str, tuple[int | None, ...]] = {"quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
        sizes["sh"] = (count, None, 3)
        if self.normals is not None:
            sizes["normals"] = (count, 3)
        for name, size in sizes.items():
            check_shape(name, getattr(self, name), *size, batches=False)
        sh_degree(self.sh.shape[1])
        check_vector("origin", self.origin)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return sh_degree(self.sh.shape[1])

    def to(self, *args: Any, **kwargs: Any) -> GaussianCloud:
        """Copy with every tensor moved or cast by :meth:`torch.Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def select(self, mask: Tensor) -> GaussianCloud:
        """The Gaussians selected by a boolean mask (N,) or an index tensor (M,)."""
        if mask.dtype == torch.bool:
            check_shape("mask", mask, len(self))
        return self._map(lambda tensor: tensor[mask])

    def rebased(self, origin: Origin) -> GaussianCloud:
        """The same Gaussians, counted from another origin."""
        if origin == self.origin:
            return self
        shift = torch.tensor(self.origin, dtype=torch.float64) - torch.tensor(origin, dtype=torch.float64)
        means = self.means.double() + shift.to(self.means.device)
        return replace(self, means=means.to(self.means), origin=origin)

    def _map(self, function: Callable[[Tensor], Tensor]) -> GaussianCloud:
        tensors = {name: getattr(self, name) for name in _TENSORS}
        changed: dict[str, Any] = {name: None if t is None else function(t) for name, t in tensors.items()}
        return replace(self, **changed)


_TENSORS = ("means", "quats", "scales", "opacities", "sh", "normals")


def joined(*clouds: GaussianCloud) -> GaussianCloud:
    """Several splats of one degree, one after the other; without normals unless all have them."""
    origin = clouds[0].origin
    if any(cloud.origin != origin for cloud in clouds):
        origin = origin_of(np.concatenate([cloud.means.double().cpu().numpy() + cloud.origin for cloud in clouds]))
    parts = {name: [getattr(cloud.rebased(origin), name) for cloud in clouds] for name in _TENSORS}
    whole: dict[str, Any] = {
        name: None if any(p is None for p in part) else torch.cat(part) for name, part in parts.items()
    }
    return GaussianCloud(**whole, origin=origin)
