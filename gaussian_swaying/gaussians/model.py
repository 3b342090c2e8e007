"""Gaussians as surface patches: normal, area, and how both and the covariance follow a deformation."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_shape
from gaussian_swaying._fixed import Fixed, fixed
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import rotate_sh, sh_to_color
from gaussian_swaying.gaussians.openness import openness
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.covariances import covariance, covariance_to_quat_scale
from gaussian_swaying.geometry.patches import deform_all, smallest_axis_normal


@fixed
@dataclass(frozen=True, slots=True)
class DeformedGaussians:
    """The properties of deformed Gaussians that renderers and shaders need.

    Attributes:
        means: Centres [scene units], shape (..., N, 3).
        covariances: Covariances F A F^T [scene units^2], shape (..., N, 3, 3).
        normals: Unit normals F^-T N, shape (..., N, 3).
        rotations: Rotation of each Gaussian from rest, the polar factor of F, shape (..., N, 3, 3).
        colors: Colours as a camera sees them, shape (..., N, 3); None before they are shaded.
        model: The Gaussians at rest, which have the opacities and harmonics; None if they are not known.
        moving: Indices of those that may have moved, shape (M,); None for all. The others are as in ``model``.
    """

    means: Tensor
    covariances: Tensor
    normals: Tensor
    rotations: Tensor
    colors: Tensor | None = None
    model: GaussianSurfaceModel | None = None
    moving: Tensor | None = None

    @torch.no_grad()
    def to_cloud(self) -> GaussianCloud:
        """The Gaussians in storage form, detached, with harmonics rotated with the patches.

        Those that have not moved keep the numbers of the splat.
        """
        model = self._known()
        check_shape("means", self.means, None, 3, batches=False)
        rest, index = model.to_cloud(), self.moving
        if index is None:
            moved: dict[str, Any] = self._moved(self.covariances, rest.sh, self.rotations)
        else:
            own = self._moved(self.covariances[index], rest.sh[index], self.rotations[index])
            moved = {name: getattr(rest, name).index_copy(0, index, part) for name, part in own.items()}
        return replace(rest, means=self.means.detach(), normals=self.normals.detach(), **moved)

    @torch.no_grad()
    def part_to_cloud(self, moving: bool) -> GaussianCloud:
        """The moving or the static part of :meth:`to_cloud`, in the order of ``moving``."""
        model = self._known()
        check_shape("means", self.means, None, 3, batches=False)
        index = torch.arange(len(self.means), device=self.means.device) if self.moving is None else self.moving
        if not moving:
            still = torch.ones(len(self.means), dtype=torch.bool, device=self.means.device)
            index = still.index_fill(0, index, False).nonzero()[:, 0]
        rest = model.part_to_cloud(index)
        changed: dict[str, Any] = self._moved(self.covariances[index], rest.sh, self.rotations[index]) if moving else {}
        return replace(rest, means=self.means.detach()[index], normals=self.normals.detach()[index], **changed)

    def _known(self) -> GaussianSurfaceModel:
        if self.model is None:
            raise ValueError("These Gaussians have no opacities: set `model` to the GaussianSurfaceModel at rest.")
        return self.model

    @staticmethod
    def _moved(covariances: Tensor, sh: Tensor, rotations: Tensor) -> dict[str, Tensor]:
        quats, scales = covariance_to_quat_scale(covariances)
        return {"quats": quats, "scales": scales, "sh": rotate_sh(sh, rotations)}


class GaussianSurfaceModel(Fixed, nn.Module):
    """3D Gaussians as surface patches (Gaussian Swaying, "Surface Formulation").

    Parameters in storage form, with the names of gsplat: ``means`` (N, 3), ``quats`` (N, 4) wxyz, ``scales`` (N, 3) as
    logarithms, ``opacities`` (N,) as logits, ``sh0`` (N, 1, 3) and ``shN`` (N, K - 1, 3).

    Args:
        cloud: Gaussians to start from.
        requires_grad: Whether the parameters are trained.
        copy: Whether the tensors of the cloud are copied; else they are shared.
    """

    assignable = ("means", "quats", "scales", "opacities", "sh0", "shN", "reference_normals")
    reference_normals: Tensor | None

    def __init__(self, cloud: GaussianCloud, requires_grad: bool = True, *, copy: bool = True) -> None:
        super().__init__()

        def parameter(tensor: Tensor) -> nn.Parameter:
            return nn.Parameter(tensor.detach().clone() if copy else tensor.detach(), requires_grad=requires_grad)

        self.means = parameter(cloud.means)
        self.quats = parameter(cloud.quats)
        self.scales = parameter(cloud.scales)
        self.opacities = parameter(cloud.opacities)
        self.sh0 = parameter(cloud.sh[:, :1])
        self.shN = parameter(cloud.sh[:, 1:])
        self.origin = cloud.origin
        self.register_buffer("reference_normals", None if cloud.normals is None else cloud.normals.detach().clone())

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud, requires_grad: bool = True, *, copy: bool = True) -> GaussianSurfaceModel:
        """The model of given Gaussians."""
        return cls(cloud, requires_grad, copy=copy)

    def to_cloud(self) -> GaussianCloud:
        """The Gaussians in storage form, detached; they share memory with the parameters except for ``sh``."""
        return self._stored(lambda tensor: tensor.detach())

    def part_to_cloud(self, index: Tensor) -> GaussianCloud:
        """The Gaussians with these indices (M,) in storage form, detached."""
        return self._stored(lambda tensor: tensor.detach()[index])

    def _stored(self, part: Callable[[Tensor], Tensor]) -> GaussianCloud:
        normals = self.reference_normals
        return GaussianCloud(
            part(self.means),
            part(self.quats),
            part(self.scales),
            part(self.opacities),
            torch.cat([part(self.sh0), part(self.shN)], dim=1),
            None if normals is None else part(normals),
            self.origin,
        )

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write a 3DGS file, with the errors of :func:`gaussian_swaying.gaussians.ply.write_ply`."""
        write_ply(path, self.to_cloud())

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh(self) -> Tensor:
        """All spherical harmonics coefficients, shape (N, K, 3)."""
        return torch.cat([self.sh0, self.shN], dim=1)

    @property
    def view_dependent(self) -> bool:
        """True if the colours depend on the view direction."""
        return self.shN.shape[1] > 0

    def covariance(self) -> Tensor:
        """Covariances at rest [scene units^2], shape (N, 3, 3)."""
        return covariance(self.quats, self.scales)

    def normals(self) -> Tensor:
        """Unit normals at rest along the smallest axes, on the side of the file's normals if it had any, (N, 3)."""
        normals = smallest_axis_normal(self.quats, self.scales)
        if self.reference_normals is None:
            return normals
        return torch.where((normals * self.reference_normals).sum(-1, keepdim=True) < 0, -normals, normals)

    def areas(self, mode: str = "coverage", neighbours: int = 24) -> Tensor:
        """Patch areas at rest [scene units^2], shape (N,).

        Args:
            mode: "paper" for :func:`patch_area`, which is differentiable, "coverage" for :func:`coverage_area`, or
                "open" for the same times :func:`~gaussian_swaying.gaussians.openness.openness`.
            neighbours: Nearest centres that "coverage" and "open" consider.

        Returns:
            Shape (N,).

        Raises:
            ValueError: If ``mode`` is none of these.
        """
        check_choice("mode", mode, ("paper", "coverage", "open"))
        if mode == "paper":
            return patch_area(self.scales)
        normals, opacity = self.normals(), self.opacity()
        area = coverage_area(self.means, normals, self.scales, opacity, neighbours)
        return area * openness(self.means, normals, self.scales, area, opacity) if mode == "open" else area

    def opacity(self) -> Tensor:
        """Opacities from 0 to 1, shape (N,)."""
        return self.opacities.sigmoid()

    def colors(self, directions: Tensor) -> Tensor:
        """RGB colours seen along directions from the camera (..., N, 3) of any length above zero; shape (..., N, 3)."""
        return sh_to_color(self.sh, directions)

    def deformed(self, position: Tensor, deformation_gradient: Tensor) -> DeformedGaussians:
        """The Gaussians after a deformation.

        Args:
            position: Deformed centres [scene units], shape (..., N, 3).
            deformation_gradient: Total deformation gradients, shape (..., N, 3, 3).

        Raises:
            ValueError: If a tensor does not have the shape above.
        """
        check_shape("position", position, len(self), 3)
        check_shape("deformation_gradient", deformation_gradient, len(self), 3, 3)
        covariances, normals, rotations = deform_all(deformation_gradient, self.covariance(), self.normals())
        assert rotations is not None
        return DeformedGaussians(position, covariances, normals, rotations, model=self)
