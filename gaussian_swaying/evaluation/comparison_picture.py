"""The picture of a comparison: reference, run and absolute error side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from gaussian_swaying.captures.images import average_down
from gaussian_swaying.rendering.passes import colormap

ERROR_SCALE = 0.25  # absolute error at the bright end of the error map
PANEL_WIDTH = 640  # pixels; wider pictures are averaged down by a whole number in the video


def _smaller(picture: Tensor, factor: int) -> Tensor:
    """Average a picture (H, W, 3) down by a whole number."""
    return rearrange(average_down(rearrange(picture, "h w c -> c h w"), factor), "c h w -> h w c")


def comparison_picture(
    reference: Tensor,
    image: Tensor,
    labels: Sequence[str] = ("reference", "run"),
) -> np.ndarray:
    """Reference, run and absolute error side by side, labelled.

    The error is the mean over the colours, from dark blue (0) to yellow (``ERROR_SCALE`` and more).

    Args:
        reference: Picture from 0 to 1, shape (H, W, 3).
        image: Picture of the run, of the same shape.

    Returns:
        Picture, uint8, shape (h + band, 3 w + gaps, 3).
    """
    from PIL import Image, ImageDraw, ImageFont

    factor = math.ceil(reference.shape[1] / PANEL_WIDTH)
    error = colormap((image - reference).abs().mean(-1) / ERROR_SCALE)
    panels = [_smaller(picture.float(), factor) for picture in (reference, image, error)]
    height, width = panels[0].shape[:2]
    band, gap = max(16, height // 14), 2
    ramp = colormap(torch.linspace(0, 1, width // 4)).expand(band // 2, -1, 3)
    bytes_of = [(p.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy() for p in (*panels, ramp)]
    whole = np.full((height + band, 3 * width + 2 * gap, 3), 24, dtype=np.uint8)
    for number, pixels in enumerate(bytes_of[:3]):
        whole[band:, number * (width + gap) :][:, :width] = pixels
    picture = Image.fromarray(whole)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(0.62 * band)
    pad, middle = band // 3, band / 2
    for number, label in enumerate((*labels, "absolute error")):
        draw.text((number * (width + gap) + pad, middle), label, (235, 235, 235), font, anchor="lm")
    end = whole.shape[1] - pad
    end -= int(draw.textlength(f"{ERROR_SCALE:g}", font))
    draw.text((end, middle), f"{ERROR_SCALE:g}", (235, 235, 235), font, anchor="lm")
    bar = end - pad // 2 - ramp.shape[1]
    picture.paste(Image.fromarray(bytes_of[3]), (bar, (band - len(ramp)) // 2))
    draw.text((bar - pad // 2, middle), "0", (235, 235, 235), font, anchor="rm")
    return np.asarray(picture)
