"""How well trained Gaussians match a known surface."""

from __future__ import annotations

import math

import torch

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.metrics.patch_normals import patch_normal_error


@torch.no_grad()
def surface_quality(
    model: GaussianSurfaceModel,
    truth: GeneratedCapture,
    a: float = 1.1,
    b: float = 0.008,
    min_opacity: float = 0.1,
    near: float = 0.05,
) -> dict[str, float]:
    """Shape, opacity, orientation, position and area of Gaussians compared with a generated surface.

    Shape, orientation, position and area are those of the simulated Gaussians, which have an opacity of at least
    ``min_opacity``.

    Args:
        model: The Gaussians, in metres.
        truth: The surface.
        a: A Gaussian counts as round up to this ratio of the two largest scales.
        b: A Gaussian counts as small up to this scale [m].
        min_opacity: Smallest opacity of simulated Gaussians.
        near: A Gaussian counts as near the surface up to this distance [m].

    Returns:
        ``gaussians`` and ``simulated`` (numbers); ``round_share``, ``small_share`` and ``near_share`` of the simulated
        ones; ``decided_share`` of all with an opacity outside [0.1, 0.9]; ``flatness_median`` (smallest over second
        largest scale); ``angle_median_deg`` and ``angle_p90_deg`` between patch normals and the normals of the nearest
        points, ignoring the sign; ``tilt_10cm_deg``, ``tilt_20cm_deg`` and ``tilt_40cm_deg`` of patches, see
        :func:`~gaussian_swaying.metrics.patch_normals.patch_normal_error`, weighted by ``coverage`` areas, of the
        Gaussians near the surface; ``distance_median_m`` and ``distance_p90_m``; ``area_paper_ratio`` and
        ``area_coverage_ratio``, sums of areas over the true area of one side.
    """
    opacity = model.opacity()
    kept = (opacity >= min_opacity).nonzero()[:, 0]
    found: dict[str, float] = {"gaussians": len(model), "simulated": len(kept)}
    found["decided_share"] = float(((opacity < 0.1) | (opacity > 0.9)).float().mean())
    part = GaussianSurfaceModel.from_cloud(model.to_cloud().select(kept), requires_grad=False)
    part.reference_normals = None
    scales = part.scales.exp().sort(dim=-1, descending=True).values
    found["round_share"] = float((scales[:, 0] / scales[:, 1] <= a).float().mean())
    found["small_share"] = float((scales[:, 0] <= b).float().mean())
    found["flatness_median"] = float((scales[:, 2] / scales[:, 1]).median())
    places, normals = truth.nearest(part.means)
    distance = (part.means.double() - places).norm(dim=-1)
    cosine = (part.normals().double() * normals).sum(-1).abs().clamp(max=1.0)
    angle = torch.rad2deg(torch.acos(cosine))
    found["near_share"] = float((distance <= near).float().mean())
    close = distance <= near
    areas = {mode: part.areas(mode) for mode in ("paper", "coverage")}
    for size in (0.1, 0.2, 0.4):
        parts = (places[close], part.normals()[close], normals[close], size, areas["coverage"][close])
        found[f"tilt_{round(100 * size)}cm_deg"] = patch_normal_error(*parts) if bool(close.any()) else math.nan
    for name, values in (("angle", angle), ("distance", distance)):
        unit = "deg" if name == "angle" else "m"
        found[f"{name}_median_{unit}"] = float(values.median())
        found[f"{name}_p90_{unit}"] = float(values.sort().values[math.ceil(0.9 * len(values)) - 1])
    for mode, area in areas.items():
        found[f"area_{mode}_ratio"] = float(area.double().sum()) / truth.area()
    return found
