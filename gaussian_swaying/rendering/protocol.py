"""The interface of renderers."""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying._fixed import fixed
from gaussian_swaying.rendering.cameras.camera import Camera

BLUR = 0.3
"""Added to the diagonal of projected covariances [pixels^2]."""
MIN_ALPHA = 1.0 / 255.0
"""A Gaussian is skipped at pixels where its alpha is smaller."""
MAX_ALPHA = 0.999
"""Upper bound of alpha, so that the transmittance stays positive."""
MIN_TRANSMITTANCE = 1e-4
"""A pixel stops before the Gaussian that would lower its transmittance to this value or below."""
SLACK = 0.01
"""Added to pixel extents [pixels] because of round-off; the exact test is on alpha."""


@fixed
@dataclass(frozen=True, slots=True, eq=False)
class RenderOutput:
    r"""Picture of a Gaussian scene.

    With the weights :math:`w_k = T_k \alpha_k` of the Gaussians at a pixel, from front to back:

    Attributes:
        color: :math:`\sum_k w_k c_k`, plus the background times :math:`1 - \sum_k w_k`, shape (H, W, 3).
        alpha: Opacity :math:`\sum_k w_k`, shape (H, W, 1).
        depth: Accumulated depth :math:`\sum_k w_k z_k` [scene units], shape (H, W, 1). Divide by ``alpha`` for the
            expected depth.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor


class Renderer(Protocol):
    """Draws Gaussians with explicit covariances."""

    def __call__(
        self,
        means: Tensor,
        covariances: Tensor,
        opacities: Tensor,
        colors: Tensor,
        camera: Camera,
        background: Tensor | None = None,
    ) -> RenderOutput:
        """Render one picture.

        Args:
            means: Centres [scene units], shape (N, 3).
            covariances: Symmetric covariances [scene units^2], shape (N, 3, 3).
            opacities: Opacities after the sigmoid, in [0, 1], shape (N,).
            colors: Colours as displayed (no spherical harmonics), shape (N, 3).
            background: Colour behind the Gaussians, shape (3,); black when None.

        Returns:
            The picture, on the device and in the precision of ``means``. A Gaussian that is not finite is not drawn.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ScreenGaussians:
    """Gaussians on the screen. Training uses this to decide which of them to split, copy or remove.

    Attributes:
        means2d: Centres [pixels], part of the autograd graph of the picture, shape (V, 2), or (1, N, 2) without
            ``index``.
        radii: Half width and height [pixels] of each, 0 for one that is not drawn, shape of ``means2d``.
        index: Index of each among the N Gaussians, shape (V,), or None if all are listed.
        width: Image width [pixels].
        height: Image height [pixels].
    """

    means2d: Tensor
    radii: Tensor
    index: Tensor | None
    width: int
    height: int

    def info(self) -> dict[str, Any]:
        """The same with the names that the strategies of gsplat 1.5 expect."""
        return {
            "means2d": self.means2d,
            "radii": self.radii,
            "gaussian_ids": self.index,
            "width": self.width,
            "height": self.height,
            "n_cameras": 1,
        }


@dataclass(frozen=True, slots=True, eq=False)
class SplatOutput:
    """Picture of a splat in training.

    Attributes:
        color: As :attr:`RenderOutput.color`, shape (H, W, 3).
        alpha: As :attr:`RenderOutput.alpha`, shape (H, W, 1).
        screen: The Gaussians on the screen.
        channels: Further values, blended like the colours over zero, shape (H, W, E), or None.
    """

    color: Tensor
    alpha: Tensor
    screen: ScreenGaussians
    channels: Tensor | None = None


class SplatRenderer(Renderer, Protocol):
    """Renderer that also draws Gaussians in storage form, for training."""

    def render_splat(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        camera: Camera,
        background: Tensor | None = None,
        channels: Tensor | None = None,
    ) -> SplatOutput:
        """Render one picture, differentiable with respect to every tensor of the splat.

        Args:
            means: Centres [scene units], shape (N, 3).
            quats: Quaternions wxyz of any length above zero, shape (N, 4).
            log_scales: Logarithm of the standard deviations [scene units], shape (N, 3).
            opacities: Opacities after the sigmoid, in [0, 1], shape (N,).
            sh: Spherical harmonics coefficients, shape (N, K, 3) with K = 1, 4, 9 or 16.
            background: Colour behind the Gaussians, shape (3,); black when None.
            channels: Further values of each Gaussian to blend in the same pass, shape (N, E).

        Returns:
            The picture, on the device and in the precision of ``means``.
        """
        ...


def check_gaussians(
    means: Tensor, covariances: Tensor, opacities: Tensor, colors: Tensor, background: Tensor | None
) -> None:
    """Raise TypeError or ValueError unless the arguments of a :class:`Renderer` have the documented shapes."""
    count = means.shape[0] if isinstance(means, Tensor) and means.dim() == 2 else "N"
    check_shape("means", means, count, 3, batches=False)
    check_shape("covariances", covariances, count, 3, 3, batches=False)
    check_shape("opacities", opacities, count, batches=False)
    check_shape("colors", colors, count, 3, batches=False)
    if background is not None:
        check_shape("background", background, 3, batches=False)


def finite_gaussians(means: Tensor, covariances: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
    """Return which Gaussians have only finite values, shape (N,), in few kernels and without waiting for the GPU."""
    with torch.no_grad():
        values = torch.cat([means, covariances.flatten(-2), opacities[:, None], colors], dim=-1)
        return torch.linalg.vector_norm(values, math.inf, dim=-1) < math.inf  # NaN is not less either
