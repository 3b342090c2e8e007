"""Gaussians as surface patches: normal, area, and how both and the covariance follow a deformation."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import warnings
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_shape
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.ply import GaussianCloud, write_ply
from gaussian_swaying.gaussians.spherical_harmonics import sh_to_color
from gaussian_swaying.mpm.linalg import cofactor, determinant, matmul3, polar_rotation


def quat_to_rotation(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions.

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).

    Returns:
        Shape (..., 3, 3); columns are the axes of the Gaussian.

    Raises:
        ValueError: If ``quats`` has another shape.
    """
    check_shape("quats", quats, 4)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def rotation_to_quat(rotation: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, by the largest of four equivalent forms (Shepperd 1978).

    Args:
        rotation: Rotation matrices, shape (..., 3, 3).

    Returns:
        Quaternions wxyz with w >= 0, shape (..., 4).

    Raises:
        ValueError: If ``rotation`` has another shape.
    """
    check_shape("rotation", rotation, 3, 3)
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotation.unbind(-2))
    # Row k is 4 q_k q: the outer product of the quaternion with itself.
    outer = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    quats = torch.nn.functional.normalize(row, dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def covariance(quats: Tensor, log_scales: Tensor) -> Tensor:
    r"""Covariances :math:`A = R S S^T R^T` (Kerbl et al. 2023, equation 6).

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Symmetric matrices [scene units^2], shape (..., 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("log_scales", log_scales, 3)
    axes = quat_to_rotation(quats) * log_scales.exp()[..., None, :]
    return axes @ axes.mT


def covariance_to_quat_scale(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions and scales of covariances, to store deformed Gaussians in a .ply file.

    Computed in float64. The axes are right-handed, sorted from the smallest, and their signs depend on the matrix
    alone. A standard deviation below 1e-7 times the largest is raised to that, so that singular matrices pass.

    Args:
        covariances: Symmetric positive semi-definite matrices [scene units^2], shape (N, 3, 3).

    Returns:
        Quaternions wxyz of unit length, shape (N, 4), and logarithm of the standard deviations [scene units],
        shape (N, 3).

    Raises:
        ValueError: If ``covariances`` has another shape.
    """
    check_shape("covariances", covariances, 3, 3)
    values, axes = torch.linalg.eigh(covariances.double())
    largest = axes.abs().argmax(-2, keepdim=True)
    axes = axes * torch.where(axes.gather(-2, largest) < 0, -1.0, 1.0)
    axes = torch.cat([axes[..., :2], torch.linalg.cross(axes[..., 0], axes[..., 1])[..., None]], dim=-1)
    floor = (values[..., -1:] * 1e-14).clamp_min(1e-60)
    log_scales = 0.5 * values.clamp_min(floor).log()
    return rotation_to_quat(axes).to(covariances.dtype), log_scales.to(covariances.dtype)


def deform_covariance(deformation_gradient: Tensor, covariances: Tensor) -> Tensor:
    r"""Covariances after a deformation, :math:`a = F A F^T` (Gaussian Swaying, "Surface Formulation").

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        covariances: Covariances A at rest [scene units^2], shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("deformation_gradient", deformation_gradient, 3, 3)
    check_shape("covariances", covariances, 3, 3)
    return matmul3(matmul3(deformation_gradient, covariances), deformation_gradient.mT)


def limit_stretch(covariances: Tensor, rest: Tensor, max_stretch: float, shape: Tensor | None = None) -> Tensor:
    r"""Covariances of Gaussians that are drawn out too far, drawn smaller and more in a shape of their own.

    The size of a Gaussian is :math:`\sqrt{\operatorname{tr} a}`. Where it is :math:`r` times that at rest and
    :math:`r > r_{max}`, the covariance becomes

    .. math::
        w\, a + (1 - w)\, B, \qquad w = \frac{r_{max}^2 - 1}{r^2 - 1},

    whose size is :math:`r_{max}` times that at rest: the shape B, drawn out a little, in place of a streak. Others stay
    as they are, and nothing jumps where the limit is reached.

    Args:
        covariances: Covariances a [scene units^2], shape (..., 3, 3).
        rest: Covariances A at rest [scene units^2], shape (..., 3, 3).
        max_stretch: Largest ratio of the sizes, above 1.
        shape: Covariances B [scene units^2] with the trace of A, shape (..., 3, 3); if None a ball, a grain that has
            lost its shape.

    Returns:
        Shape (..., 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("covariances", covariances, 3, 3)
    check_shape("rest", rest, 3, 3)
    size, size_at_rest = _trace(covariances)[..., None, None], _trace(rest)[..., None, None]
    excess = (max_stretch**2 - 1) * size_at_rest
    over = size - size_at_rest
    weight = excess / torch.maximum(over, excess)
    if shape is None:
        shape = torch.eye(3, dtype=rest.dtype, device=rest.device) * (size_at_rest / 3)
    else:
        check_shape("shape", shape, 3, 3)
    return torch.where(over > excess, weight * covariances + (1 - weight) * shape, covariances)


def limit_deformed(
    deformation_gradient: Tensor,
    covariances: Tensor,
    rest: Tensor,
    max_stretch: float,
    solid: Tensor,
    rotations: Tensor | None = None,
) -> Tensor:
    """:func:`limit_stretch` with the shape that suits the material: its own where that still means something.

    A Gaussian of a solid goes back towards its shape at rest, turned with the material; one of a material that flows
    towards a ball. On a CPU only those beyond the limit are computed; elsewhere all are, so that no host waits.

    Args:
        deformation_gradient: Total deformation gradient F, shape (N, 3, 3).
        covariances: Covariances F A F^T [scene units^2], shape (N, 3, 3).
        rest: Covariances A at rest [scene units^2], shape (N, 3, 3).
        max_stretch: Largest ratio of the sizes, above 1.
        solid: Which keep their shape, bool, shape (N,).
        rotations: Polar factors of F, shape (N, 3, 3), if they are known.

    Returns:
        Shape (N, 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("deformation_gradient", deformation_gradient, "N", 3, 3)
    check_shape("covariances", covariances, len(deformation_gradient), 3, 3)
    check_shape("rest", rest, len(deformation_gradient), 3, 3)
    check_shape("solid", solid, len(deformation_gradient))
    if covariances.device.type == "cpu":
        beyond = (_trace(covariances) > max_stretch**2 * _trace(rest)).nonzero()[:, 0]
        if len(beyond) == 0:
            return covariances
        turn = polar_rotation(deformation_gradient[beyond]) if rotations is None else rotations[beyond]
        part = (covariances[beyond], rest[beyond])
        return covariances.index_copy(0, beyond, limit_stretch(*part, max_stretch, _own(part[1], turn, solid[beyond])))
    turn = polar_rotation(deformation_gradient) if rotations is None else rotations
    return limit_stretch(covariances, rest, max_stretch, _own(rest, turn, solid))


def _own(rest: Tensor, turn: Tensor, solid: Tensor) -> Tensor:
    """The shape at rest turned, and for what is not solid the ball with its trace."""
    ball = torch.eye(3, dtype=rest.dtype, device=rest.device) * (_trace(rest)[:, None, None] / 3)
    return torch.where(solid[:, None, None], matmul3(matmul3(turn, rest), turn.mT), ball)


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=-2, dim2=-1).sum(-1)


def smallest_axis_normal(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Unit normals along the smallest axis of each Gaussian (Guedon & Lepetit 2024, "SuGaR").

    The sign is that of the axis in the rotation matrix, so it carries no meaning of inside or outside.

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Shape (..., 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("log_scales", log_scales, 3)
    rotation = quat_to_rotation(quats)
    index = log_scales.argmin(-1)[..., None, None].expand(*log_scales.shape[:-1], 3, 1)
    return rotation.gather(-1, index).squeeze(-1)


def deform_normal(deformation_gradient: Tensor, normals: Tensor) -> Tensor:
    r"""Unit normals after a deformation, :math:`n = F^{-T} N / \lVert F^{-T} N \rVert` (Gaussian Swaying).

    Computed from the cofactor matrix, :math:`F^{-T} = \operatorname{cof}(F) / \det F`, which needs no inverse and is
    finite for a singular F. Where cof(F) N is zero, because F flattens the patch to a line, the normal at rest stays.

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).

    Returns:
        Shape (..., 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    cof, vector = _cofactor_times(deformation_gradient, normals)
    return _unit_normal(vector, determinant(deformation_gradient, cof), normals)


def deform_area(deformation_gradient: Tensor, normals: Tensor, areas: Tensor) -> Tensor:
    r"""Patch areas after a deformation, :math:`a = \lVert \operatorname{cof}(F) N \rVert A` (Nanson's formula).

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).
        areas: Areas A at rest [scene units^2], shape (...).

    Returns:
        Shape (...).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    return _cofactor_times(deformation_gradient, normals)[1].norm(dim=-1) * areas


def deform_patch(deformation_gradient: Tensor, normals: Tensor, areas: Tensor) -> tuple[Tensor, Tensor]:
    """Normals and areas after a deformation: :func:`deform_normal` and :func:`deform_area` from one cofactor matrix.

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).
        areas: Areas A at rest [scene units^2], shape (...).

    Returns:
        Shapes (..., 3) and (...).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    cof, vector = _cofactor_times(deformation_gradient, normals)
    normal = _unit_normal(vector, determinant(deformation_gradient, cof), normals)
    return normal, vector.norm(dim=-1) * areas


def _unit_normal(vector: Tensor, determinants: Tensor, normals: Tensor) -> Tensor:
    """F^-T N made unit from cof(F) N (..., 3) and det F (...); the normals at rest where that is zero."""
    largest = torch.linalg.vector_norm(vector.detach(), float("inf"), dim=-1, keepdim=True)
    flat = largest == 0
    # + 0.0, as the sign of a negative zero is no reflection
    scale = torch.where(flat, 1, largest).copysign(determinants.detach()[..., None] + 0.0)
    vector = torch.where(flat, normals, vector / scale)  # scaled: squares cannot underflow
    return vector / vector.square().sum(-1, keepdim=True).sqrt()


def _cofactor_times(deformation_gradient: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """The cofactors of F (..., 3, 3) and their product with N (..., 3)."""
    check_shape("deformation_gradient", deformation_gradient, 3, 3)
    check_shape("normals", normals, 3)
    cof = cofactor(deformation_gradient)
    return cof, (cof * normals[..., None, :]).sum(-1)


def deform_all(
    deformation_gradient: Tensor,
    covariances: Tensor,
    normals: Tensor,
    rotations: bool = True,
    max_stretch: float | None = None,
    solid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Covariances, normals and rotations after a deformation, on a GPU in one kernel if triton is there.

    Args:
        deformation_gradient: Total deformation gradient F, shape (N, 3, 3).
        covariances: Covariances A at rest [scene units^2], shape (N, 3, 3).
        normals: Unit normals N at rest, shape (N, 3).
        rotations: Whether the rotations are asked for.
        max_stretch: Limit of :func:`limit_deformed`, above 1; None for none.
        solid: Which keep their shape beyond that limit, bool, shape (N,); with ``max_stretch``.

    Returns:
        :func:`deform_covariance` within the limit, :func:`deform_normal` and
        :func:`~gaussian_swaying.mpm.linalg.polar_rotation`, or None in its place.

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("deformation_gradient", deformation_gradient, 3, 3)
    check_shape("covariances", covariances, 3, 3)
    check_shape("normals", normals, 3)
    tensors = (deformation_gradient, covariances, normals)
    single = all(tensor.dtype == torch.float32 for tensor in tensors)
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if deformation_gradient.device.type == "cuda" and single and not wanted:
        kernels = _kernels()
        if kernels is not None:
            return kernels.deform_all(*tensors, rotations, max_stretch, solid)
    drawn = deform_covariance(deformation_gradient, covariances)
    turns = polar_rotation(deformation_gradient) if rotations else None
    if max_stretch is not None and solid is not None:
        drawn = limit_deformed(deformation_gradient, drawn, covariances, max_stretch, solid, turns)
    return drawn, deform_normal(deformation_gradient, normals), turns


@functools.cache
def _kernels() -> ModuleType | None:
    """The kernels, if triton is there and finds a compiler; tried on one patch."""
    if importlib.util.find_spec("triton") is None:
        return None
    try:
        kernels = importlib.import_module("gaussian_swaying.gaussians.surface_triton")
        matrix = torch.zeros(1, 3, 3, device="cuda")
        solid = torch.ones(1, dtype=torch.bool, device="cuda")
        for rotations in (False, True):
            for limit in (None, 2.0):
                kernels.deform_all(matrix, matrix, matrix[:, 0], rotations, limit, solid)
    except Exception as error:  # whatever it is, the definition does the same
        warnings.warn(f"triton cannot compile its kernels here ({error}): pictures take longer.", stacklevel=2)
        return None
    return kernels


@dataclass(frozen=True, slots=True)
class DeformedGaussians:
    """What a renderer and a shader need of Gaussians after a deformation.

    Attributes:
        means: Centres [scene units], shape (..., N, 3).
        covariances: Covariances F A F^T [scene units^2], shape (..., N, 3, 3).
        normals: Unit normals F^-T N, shape (..., N, 3).
        rotations: Rotation of each Gaussian from rest, the polar factor of F, shape (..., N, 3, 3).
    """

    means: Tensor
    covariances: Tensor
    normals: Tensor
    rotations: Tensor


class GaussianSurfaceModel(nn.Module):
    """3D Gaussians as surface patches (Gaussian Swaying, "Surface Formulation").

    Parameters in storage form, with the names of gsplat: ``means`` (N, 3), ``quats`` (N, 4) wxyz, ``scales`` (N, 3) as
    logarithms, ``opacities`` (N,) as logits, ``sh0`` (N, 1, 3) and ``shN`` (N, K - 1, 3).

    Args:
        cloud: Gaussians to start from; their tensors are copied.
        requires_grad: Whether the parameters are to be trained.
    """

    reference_normals: Tensor | None

    def __init__(self, cloud: GaussianCloud, requires_grad: bool = True) -> None:
        super().__init__()

        def parameter(tensor: Tensor) -> nn.Parameter:
            return nn.Parameter(tensor.detach().clone(), requires_grad=requires_grad)

        self.means = parameter(cloud.means)
        self.quats = parameter(cloud.quats)
        self.scales = parameter(cloud.scales)
        self.opacities = parameter(cloud.opacities)
        self.sh0 = parameter(cloud.sh[:, :1])
        self.shN = parameter(cloud.sh[:, 1:])
        self.register_buffer("reference_normals", None if cloud.normals is None else cloud.normals.detach().clone())

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud, requires_grad: bool = True) -> GaussianSurfaceModel:
        """The model of given Gaussians."""
        return cls(cloud, requires_grad)

    @classmethod
    def from_ply(cls, path: str | os.PathLike[str], requires_grad: bool = True) -> GaussianSurfaceModel:
        """The model of a file that :func:`~gaussian_swaying.gaussians.compact.read_gaussians` reads."""
        return cls(read_gaussians(path), requires_grad)

    def to_cloud(self) -> GaussianCloud:
        """The Gaussians in storage form, detached; they share memory with the parameters except for ``sh``."""
        return GaussianCloud(
            means=self.means.detach(),
            quats=self.quats.detach(),
            scales=self.scales.detach(),
            opacities=self.opacities.detach(),
            sh=self.sh.detach(),
            normals=self.reference_normals,
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
        """Whether the colours depend on where they are seen from."""
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
            mode: "paper" for :func:`patch_area`, which is differentiable, or "coverage" for :func:`coverage_area`.
            neighbours: Nearest centres that "coverage" considers.

        Returns:
            Shape (N,).

        Raises:
            ValueError: If ``mode`` is neither.
        """
        check_choice("mode", mode, ("paper", "coverage"))
        if mode == "paper":
            return patch_area(self.scales)
        return coverage_area(self.means, self.normals(), self.scales, self.opacity(), neighbours)

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

        Returns:
            Centres, covariances, normals and rotations.

        Raises:
            ValueError: If a tensor does not have the shape above.
        """
        check_shape("position", position, len(self), 3)
        check_shape("deformation_gradient", deformation_gradient, len(self), 3, 3)
        covariances, normals, rotations = deform_all(deformation_gradient, self.covariance(), self.normals())
        assert rotations is not None
        return DeformedGaussians(position, covariances, normals, rotations)
