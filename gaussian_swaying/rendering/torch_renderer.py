"""Renderer in plain torch, for any device; the definition of those in kernels.

Elliptical weighted averaging (Zwicker et al. 2001, "EWA volume splatting") with front-to-back compositing (Kerbl et
al. 2023, arXiv 2308.04079), in the conventions of ``gsplat.rasterization(rasterize_mode="classic")``.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from gaussian_swaying._checks import check_positive
from gaussian_swaying._devices import in_double
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.rendering import raster
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import (
    BLUR,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    SLACK,
    RenderOutput,
    ScreenGaussians,
    SplatOutput,
    check_gaussians,
    finite_gaussians,
)
from gaussian_swaying.rendering.thinning import thinned

PAIRS = 1 << 18
"""About how many pairs of a Gaussian and a pixel are in memory at a time; autograd keeps them all."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedGaussians:
    """Gaussians that may touch the image, from front to back.

    Attributes:
        index: Index of each in the input, shape (V,).
        means2d: Centres [pixels], shape (V, 2).
        covariances2d: Entries xx, xy, yy of the blurred covariances [pixels^2], shape (V, 3).
        depths: Depth of the centres [scene units], shape (V,).
        log_opacities: Logarithm of the opacities, shape (V,).
    """

    index: Tensor
    means2d: Tensor
    covariances2d: Tensor
    depths: Tensor
    log_opacities: Tensor


def project_gaussians(means: Tensor, covariances: Tensor, opacities: Tensor, camera: Camera) -> ProjectedGaussians:
    r"""Project Gaussians to the image with the local affine approximation of the perspective.

    With camera points :math:`(x, y, z)`, the world-to-camera rotation :math:`W` and :math:`\hat x = x / z`,
    :math:`\hat y = y / z` clamped to the image widened by 15 % of its size on each side,

    .. math::
        \Sigma' = J W \Sigma W^\top J^\top + \epsilon I, \qquad
        J = \frac{1}{z} \begin{pmatrix} f_x & 0 & -f_x \hat x \\ 0 & f_y & -f_y \hat y \end{pmatrix}.

    A Gaussian is left out if it is not finite, if its centre is in front of the near plane, if its opacity is below
    1/255, or if the ellipse where its alpha reaches 1/255 is outside the image. That ellipse has
    :math:`\sqrt{2 \ln(255\,o)} \le 3.33` standard deviations (Radl et al. 2024, arXiv 2402.00525, appendix B.2).

    Returns:
        The V remaining Gaussians, sorted by depth; Gaussians of equal depth keep their order.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    (fx, fy), (cx, cy) = camera.intrinsics.diagonal()[:2], camera.intrinsics[:2, 2]
    with torch.no_grad():
        depth = means @ rotation[2] + translation[2]
        in_front = (depth >= camera.near) & (depth < math.inf) & (opacities >= MIN_ALPHA)
        index = in_front.nonzero().squeeze(-1)
        index = index[torch.argsort(depth[index], stable=True)]
    means, covariances, opacities = means[index], covariances[index], opacities[index]
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    x_ratio, y_ratio = x / z, y / z
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    x_hat = torch.clamp(x_ratio, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    y_hat = torch.clamp(y_ratio, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    row_x = (fx / z)[:, None] * (rotation[0] - x_hat[:, None] * rotation[2])
    row_y = (fy / z)[:, None] * (rotation[1] - y_hat[:, None] * rotation[2])
    sigma_x = (covariances @ row_x[..., None]).squeeze(-1)
    sigma_y = (covariances @ row_y[..., None]).squeeze(-1)
    xx = (row_x * sigma_x).sum(-1) + BLUR
    xy = (row_x * sigma_y).sum(-1)
    yy = (row_y * sigma_y).sum(-1) + BLUR
    means2d = torch.stack([fx * x_ratio + cx, fy * y_ratio + cy], -1)
    covariances2d = torch.stack([xx, xy, yy], -1)
    log_opacities = opacities.log()
    with torch.no_grad():
        extent = _extent(covariances2d, log_opacities)
        size = means2d.new_tensor([camera.width, camera.height])
        inside = ((means2d + extent > 0) & (means2d - extent < size)).all(-1)
        determinant = xx * yy - xy * xy
        keep = (inside & (determinant > 0) & (determinant < math.inf) & (yy > 0)).nonzero().squeeze(-1)
    return ProjectedGaussians(
        index=index[keep],
        means2d=means2d[keep],
        covariances2d=covariances2d[keep],
        depths=z[keep],
        log_opacities=log_opacities[keep],
    )


def _extent(covariances2d: Tensor, log_opacities: Tensor) -> Tensor:
    """Half width and height [pixels] of the ellipse where alpha reaches 1/255, shape (V, 2)."""
    reach = 2.0 * (log_opacities - math.log(MIN_ALPHA)).clamp_min(0.0)
    return (reach[:, None] * covariances2d[:, [0, 2]]).sqrt() + SLACK


def _blocks(counts: Tensor) -> tuple[Tensor, list[tuple[int, int]]]:
    running = counts.cumsum(0)
    total = int(running[-1]) if len(running) else 0
    marks = torch.arange(PAIRS, total + PAIRS, PAIRS, device=counts.device)
    ends = [0, *(torch.searchsorted(running, marks).clamp_max(len(running) - 1) + 1).tolist()] if total else []
    return running, [(start, end) for start, end in pairwise(ends) if end > start]


@dataclass(frozen=True, slots=True, eq=False)
class _Spans:
    """Runs of pixels in one image row that a Gaussian covers, from front to back.

    With the distance u of a pixel from the start of the run, alpha = exp(peak - curvature * (u + offset)^2).
    """

    gaussian: Tensor
    pixel: Tensor
    count: Tensor
    offset: Tensor
    peak: Tensor
    curvature: Tensor


def _row_spans(projected: ProjectedGaussians, width: int, height: int) -> Iterator[_Spans]:
    r"""Split each Gaussian into the rows it covers, about ``PAIRS`` rows at a time.

    In the row at height dy over the centre, the exponent of the Gaussian splits into a square in x and a rest,

    .. math::
        \tfrac12 d^\top \Sigma'^{-1} d = \frac{\sigma_{yy}}{2 \det \Sigma'}
        \Bigl(d_x - \frac{\sigma_{xy}}{\sigma_{yy}} d_y\Bigr)^2 + \frac{d_y^2}{2 \sigma_{yy}},

    which gives the run of pixels with alpha of at least 1/255, for any thin and slanted ellipse, and without
    cancellation.
    """
    xx, xy, yy = projected.covariances2d.unbind(-1)
    per_gaussian = torch.stack(
        [projected.means2d[:, 0], projected.means2d[:, 1], xy / yy, 0.5 / yy, 0.5 * yy / (xx * yy - xy * xy)], -1
    )
    with torch.no_grad():
        reach = _extent(projected.covariances2d, projected.log_opacities)[:, 1]
        center = projected.means2d[:, 1] - 0.5
        first = (center - reach).ceil().clamp(0, height).long()
        rows = ((center + reach).floor().clamp(-1, height - 1).long() - first + 1).clamp_min(0)
        running, blocks = _blocks(rows)
        shift = first - running + rows
    for start, end in blocks:
        with torch.no_grad():
            gaussian = torch.arange(start, end, device=rows.device).repeat_interleave(rows[start:end])
            begin = int(running[start] - rows[start])
            row = torch.arange(begin, begin + len(gaussian), device=rows.device) + shift[gaussian]
        mean_x, mean_y, slope, falloff, curvature = per_gaussian.index_select(0, gaussian).unbind(-1)
        dy = row + 0.5 - mean_y
        middle = mean_x + slope * dy - 0.5
        peak = projected.log_opacities.index_select(0, gaussian) - falloff * dy * dy
        with torch.no_grad():
            half = ((peak - math.log(MIN_ALPHA)).clamp_min(0.0) / curvature).sqrt() + SLACK
            left = (middle - half).ceil().clamp(0, width)
            count = ((middle + half).floor().clamp(-1, width - 1) - left + 1).clamp_min(0).long()
        yield _Spans(gaussian.int(), (row * width + left.long()).int(), count, left - middle, peak, curvature)


def composite_gaussians(
    projected: ProjectedGaussians, features: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    r"""Blend projected Gaussians from front to back.

    .. math::
        \alpha_k = \min(0.999, o_k e^{-\frac12 d^\top \Sigma_k'^{-1} d}), \qquad
        T_k = \prod_{j < k} (1 - \alpha_j), \qquad f = \sum_k T_k \alpha_k f_k

    (Kerbl et al. 2023, equation 3), without the Gaussians with :math:`\alpha_k < 1/255` and from the first with
    :math:`T_{k+1} \le 10^{-4}` on. The logarithm of the transmittance is summed in float64. Deterministic bit for bit
    on the CPU.

    Args:
        features: Values to blend, shape (V, D).

    Returns:
        Blended features, shape (H, W, D), and opacity :math:`\sum_k T_k \alpha_k`, shape (H, W, 1).
    """
    pixel_count = width * height
    log_stop = math.log(MIN_TRANSMITTANCE)
    blended = features.new_zeros(pixel_count, features.shape[-1] + 1)
    log_transmittance = torch.zeros(pixel_count, dtype=torch.float64, device=features.device)
    features = torch.cat([features, torch.ones_like(features[:, :1])], -1)
    started = False
    for spans in _row_spans(projected, width, height):
        running, blocks = _blocks(spans.count)
        before = running - spans.count
        for start, end in blocks:
            with torch.no_grad():
                local = torch.arange(end - start, dtype=torch.int32, device=running.device)
                span = local.repeat_interleave(spans.count[start:end])
                # Pixels from the start of the span: the index of the pair minus that of the span's first pair.
                step = torch.arange(len(span), dtype=torch.int32, device=running.device)
                step -= (before[start:end] - before[start]).int().index_select(0, span)
                pixel = step + spans.pixel[start:end].index_select(0, span)
                if started:
                    going = log_transmittance > log_stop
                    keep = going.index_select(0, pixel).nonzero().squeeze(-1)
                    span, step, pixel = (item.index_select(0, keep) for item in (span, step, pixel))
                pixel, order = torch.sort(pixel, stable=True)
                span, step = span.index_select(0, order), step.index_select(0, order)
                bounds = functional.pad(torch.bincount(pixel, minlength=pixel_count).cumsum(0), (1, 0)).int()
            distance = step + spans.offset[start:end].index_select(0, span)
            falloff = spans.curvature[start:end].index_select(0, span) * distance.square()
            exponent = spans.peak[start:end].index_select(0, span) - falloff
            alpha = exponent.exp().clamp_max(MAX_ALPHA)
            alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
            log_factor = in_double(torch.log1p(-alpha))
            summed = functional.pad(log_factor.cumsum(0), (1, 0))
            at_bounds = summed.index_select(0, bounds)
            entry = log_transmittance - at_bounds[:-1]
            transmittance = (summed[:-1] + entry.index_select(0, pixel)).to(alpha).exp()
            weight = torch.where(transmittance * (1.0 - alpha) > MIN_TRANSMITTANCE, transmittance * alpha, 0.0)
            blended = blended + functional.embedding_bag(
                spans.gaussian[start:end].index_select(0, span),
                features,
                bounds,
                mode="sum",
                per_sample_weights=weight,
                include_last_offset=True,
            )
            log_transmittance = entry + at_bounds[1:]
            started = True
    image = blended.reshape(height, width, -1)
    return image[..., :-1], image[..., -1:]


def render_torch(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None = None,
) -> RenderOutput:
    """Draw Gaussians, see :func:`project_gaussians` and :func:`composite_gaussians`.

    Differentiable with respect to ``means``, ``covariances``, ``opacities``, ``colors`` and ``background``.

    Returns:
        The picture, on the device and in the precision of ``means``.
    """
    check_gaussians(means, covariances, opacities, colors, background)
    camera = camera.to(means.device, means.dtype)
    opacities = torch.where(finite_gaussians(means, covariances, opacities, colors), opacities, 0.0)
    projected = project_gaussians(means, covariances, opacities, camera)
    features = torch.cat([colors[projected.index], projected.depths[:, None]], -1)
    blended, alpha = composite_gaussians(projected, features, camera.width, camera.height)
    color = blended[..., :3]
    if background is not None:
        color = color + (1.0 - alpha) * background.to(color)
    return RenderOutput(color, alpha, blended[..., 3:])


class TorchRenderer(nn.Module):
    """Renderer for any device, see :func:`render_torch`.

    On a CPU, pictures in float32 without gradients are drawn by compiled kernels
    (:mod:`~gaussian_swaying.rendering.raster`), if llvmlite is installed.

    Args:
        detail: Size [pixels] below which Gaussians are thinned, 0 for none
            (:func:`~gaussian_swaying.rendering.thinning.thinned`). Training always draws all.

    Raises:
        ValueError: If ``detail`` is negative.
    """

    def __init__(self, detail: float = 0.0) -> None:
        super().__init__()
        check_positive("detail", detail, allow_zero=True)
        self.detail = float(detail)

    def forward(
        self,
        means: Tensor,
        covariances: Tensor,
        opacities: Tensor,
        colors: Tensor,
        camera: Camera,
        background: Tensor | None = None,
    ) -> RenderOutput:
        """Render one picture, see :class:`~gaussian_swaying.rendering.protocol.Renderer`."""
        check_gaussians(means, covariances, opacities, colors, background)
        given = (means, covariances, opacities, colors)
        # the kernels read the others in any precision
        wanted = [
            t for t in (background, camera.world_to_camera, camera.intrinsics) if t is not None and t.requires_grad
        ]
        if raster.runs(given) and not (wanted and torch.is_grad_enabled()):
            picture = raster.render(*given, camera, background, self.detail)
            if picture is not None:
                return picture
        if self.detail > 0:
            given = thinned(*given, camera.to(means.device, means.dtype), self.detail)
        return render_torch(*given, camera, background)

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
        """Render one picture in training, see :class:`~gaussian_swaying.rendering.protocol.SplatRenderer`."""
        camera = camera.to(means.device, means.dtype)
        # after the projection, so that only visible Gaussians get a colour
        covariances = covariance(quats, log_scales)
        finite = finite_gaussians(means, covariances, opacities, sh.flatten(1))
        projected = project_gaussians(means, covariances, torch.where(finite, opacities, 0.0), camera)
        colors = sh_to_color(sh[projected.index], means[projected.index] - camera.position)
        values = colors if channels is None else torch.cat([colors, channels[projected.index]], dim=-1)
        blended, alpha = composite_gaussians(projected, values, camera.width, camera.height)
        color = blended[..., :3]
        if background is not None:
            color = color + (1.0 - alpha) * background.to(color)
        with torch.no_grad():
            radii = _extent(projected.covariances2d, projected.log_opacities)
        screen = ScreenGaussians(projected.means2d, radii, projected.index, camera.width, camera.height)
        return SplatOutput(color, alpha, screen, None if channels is None else blended[..., 3:])
