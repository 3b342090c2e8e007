"""What ``bench.py detail`` measures: pictures on a CPU in which small Gaussians are thinned, against whole ones."""

from __future__ import annotations

import argparse
import io
import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from bench.case import Case, Measurement, numbers, option
from bench.places import place
from bench.record import Row
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.rendering.thinning import DETAIL, thinned
from gaussian_swaying.rendering.torch_renderer import TorchRenderer
from gaussian_swaying.viewer.screen import JPEG_QUALITY

UP = (0.0, -1.0, 0.0)
BACKGROUND = (0.5, 0.6, 0.7)
REPEATS = 5


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """A captured plant, and a place, from several distances."""
    if options.ply:
        cloud = read_gaussians(options.ply, sh_degree=0)
        few = cloud.means[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))[:100_000]]
        low, high = torch.quantile(few, 0.01, 0), torch.quantile(few, 0.99, 0)
        yield from _of("captured plant", cloud, 0.5 * (low + high), float((high - low).amax()), options)
    for count in options.counts:
        cloud, plant = place(count, sh_degree=0)
        means = cloud.means[plant]
        low, high = means.amin(0), means.amax(0)
        yield from _of("place", cloud, 0.5 * (low + high), float((high - low).amax()), options)


def _of(
    name: str, cloud: GaussianCloud, center: Tensor, size: float, options: argparse.Namespace
) -> Iterator[Measurement]:
    for width in options.widths:
        for distance in options.distances:
            key = {"scene": name, "gaussians": len(cloud), "width": width, "distance": distance}
            yield ("detail", key), partial(seen, cloud, center, size, distance, width)


@torch.inference_mode()
def seen(cloud: GaussianCloud, center: Tensor, size: float, distance: float, width: int) -> Row:
    """How many Gaussians are drawn, how long that takes, and what is lost.

    The loss is the PSNR of the pixels that are at least 2 % covered, against the picture of all Gaussians; beside it is
    that of a JPEG of the live page's quality.

    Args:
        cloud: The Gaussians, with constant colours.
        center: What the camera looks at [scene units], shape (3,).
        size: Its longest side [scene units].
        distance: Of the camera, in longest sides.
        width: Of the picture [pixels].
    """
    path = OrbitCamera(width=width, height=width * 9 // 16, azimuth=-70.0, elevation=12.0, radius=distance)
    camera = path(0, 0.0, center.double(), torch.tensor(UP).double(), size).to("cpu", torch.float32)
    shape, opacity = covariance(cloud.quats, cloud.scales), cloud.opacities.sigmoid()
    colours = sh_to_color(cloud.sh, cloud.means - camera.position)
    given = (cloud.means, shape, opacity, colours, camera, torch.tensor(BACKGROUND))
    whole, whole_s = _fastest(partial(TorchRenderer(), *given))
    some, some_s = _fastest(partial(TorchRenderer(detail=DETAIL), *given))
    covered = whole.alpha[..., 0] > 0.02

    def psnr(picture: Tensor) -> float | None:
        error = float((picture - whole.color)[covered].double().square().mean())
        return -10 * math.log10(error) if error > 0 else None

    return {
        "kept": len(thinned(*given[:5])[0]) / len(cloud),
        "covered": float(covered.double().mean()),
        "whole_s": whole_s,
        "some_s": some_s,
        "psnr_db": psnr(some.color),
        "jpeg_db": psnr(_jpeg(whole.color)),
    }


def _fastest(draw: Callable[[], RenderOutput]) -> tuple[RenderOutput, float]:
    """A picture, and the shortest of some times that it took [s]."""
    best = math.inf
    for _ in range(REPEATS):
        begin = time.perf_counter()
        picture = draw()
        best = min(best, time.perf_counter() - begin)
    return picture, best


def _jpeg(picture: Tensor) -> Tensor:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray((picture.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()).save(file, "jpeg", quality=JPEG_QUALITY)
    return torch.from_numpy(np.array(Image.open(file))).float() / 255


CASE = Case(
    "Measure what thinning small Gaussians saves and loses on a CPU.",
    rows,
    (
        option("--ply", "a captured object, y down"),
        numbers("--counts", "Gaussians of the places", default="1000000,3000000"),
        numbers("--distances", "of the camera, in sizes of the object", float, "1,2,4,8"),
        numbers("--widths", "of the pictures [pixels]", default="224,640"),
    ),
    page="live.md",
    device=False,
)
