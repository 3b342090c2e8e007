"""Photographs on disk as pixels for training: read, composited, undistorted and downscaled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as functional
from einops import rearrange
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.captures.lens import Lens, remap
from gaussian_swaying.captures.photos import UNREADABLE

_PIXELS = 80_000_000  # plus one for each byte of the file: reading takes about 12 bytes per pixel
_ORIENTATION = 0x112  # number of the EXIF tag
_WITH_ALPHA = ("RGBA", "LA", "PA", "P", "La", "RGBa")


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """One image as described by a capture's files.

    Attributes:
        name: Path of the image as written in the files.
        path: The image on disk.
        lens: Its intrinsics and size.
        world_to_camera: Pose with OpenCV axes, float64, shape (4, 4).
        split: ``train``, ``val`` or ``test`` if the files define it, else None.
        mask: Picture that is white on the object and black where the photo is to be empty, or None.
    """

    name: str
    path: Path
    lens: Lens
    world_to_camera: Tensor
    split: str | None = None
    mask: Path | None = None


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of an image file [pixels], from its header."""
    return image_head(path)[0]


def image_head(path: str | Path) -> tuple[tuple[int, int], int]:
    """Width and height of an image file [pixels], and its EXIF orientation, 1 to 8; 1 without one."""
    from PIL import Image

    _refuse_pipes(path)
    try:
        with Image.open(path) as image:
            width, height = image.size
            # without such a block at its head, a PNG would be decoded to look for one at its end
            tags = {} if image.format == "PNG" and "exif" not in image.info else image.getexif()
    except Exception as error:  # the readers of the formats raise many kinds of errors
        raise _unreadable(path, error) from error
    if width * height > _PIXELS + Path(path).stat().st_size:
        raise ValueError(
            f"The image {path} claims {width:,} x {height:,} pixels, too many for its file size: make it smaller, or "
            "delete it to leave it out."
        )
    orientation = tags.get(_ORIENTATION, 1)
    return (width, height), orientation if orientation in range(1, 9) else 1


def read_image(path: str | Path, turned: bool = False) -> Tensor:
    """Read an image of 8 or 16 bits, grey or colour, with or without alpha.

    Args:
        turned: Whether to turn the pixels as the EXIF tag says, as viewers do, and most tools for camera poses do not.

    Returns:
        Pixels, dtype uint8, shape (H, W, 3), or (H, W, 4) if the image is not fully opaque.
    """
    import imageio.v3 as iio

    _refuse_pipes(path)
    try:
        with cast(Any, iio.imopen(path, "r", plugin="pillow")) as file:
            mode = file.metadata(index=0)["mode"]
            deep = mode.startswith("I")
            convert = None if deep or mode == "F" else "RGBA" if mode in _WITH_ALPHA else "RGB"
            pixels = np.asarray(file.read(index=0, mode=convert))
    except Exception as error:  # the readers of the formats raise many kinds of errors
        raise _unreadable(path, error) from error
    if mode == "F":
        raise ValueError(f"The image {path} has floating-point numbers: convert it to 8-bit PNG or JPEG.")
    if deep:
        pixels = np.repeat((pixels.astype(np.int64) // 257).clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    if pixels.shape[-1] == 4 and bool((pixels[..., 3] == 255).all()):
        pixels = pixels[..., :3]
    orientation = image_head(path)[1] if turned else 1
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return torch.from_numpy(np.array(pixels, dtype=np.uint8))


def _refuse_pipes(path: str | Path) -> None:
    """Raise ValueError if the path is not a regular file; reading a pipe may never end."""
    if Path(path).exists():
        check_regular(path, "the image")


def _unreadable(path: str | Path, error: Exception) -> ValueError:
    if not Path(path).is_file():
        return ValueError(f"The image {path} does not exist: restore it, or remove its entry.")
    if Path(path).suffix.lower() in UNREADABLE:
        return ValueError(
            f"The image {path} is in a format that cannot be read here: convert all such photos to JPEG or PNG beside "
            "it; the camera file may keep their names."
        )
    first = str(error).strip().split("\n")[0] or type(error).__name__
    return ValueError(f"The image {path} cannot be read ({first}): copy it again, or delete it to leave it out.")


def load_image(
    path: str | Path, lens: Lens, downscale: int = 1, turned: bool = False, mask: Path | None = None
) -> Tensor:
    """Read an image, undistort it and average it down.

    Colours are premultiplied with alpha first, so that transparent pixels do not bleed into others.

    Args:
        downscale: Each pixel of the result is the mean of a square of this many pixels on a side.

    Returns:
        Pixels, dtype uint8, shape (H, W, 3), or (H, W, 4) with colours that are multiplied with alpha. Their lens is
        ``lens.undistorted().averaged(downscale)``.
    """
    pixels = read_image(path, turned)
    check_image_size(path, (pixels.shape[1], pixels.shape[0]), lens)
    if downscale == 1 and not lens.distorted and pixels.shape[-1] == 3 and mask is None:
        return pixels
    image = rearrange(pixels, "h w c -> c h w").float()
    if mask is not None:
        cover = read_mask(mask, path, lens)[None].float()
        image = torch.cat([image[:3], cover if len(image) == 3 else cover * image[3:] / 255])
    if len(image) == 4:
        image[:3] *= image[3:] / 255
    if lens.distorted:
        image = remap(image, lens, lens.undistorted())
    if downscale > 1:
        image = average_down(image, downscale)
    return _pixels_of(image)


def read_mask(mask: Path, path: str | Path, lens: Lens) -> Tensor:
    """Read the mask of a photo at the size of its lens: uint8, shape (H, W)."""
    pixels = read_image(mask).float()
    found = pixels[..., 0] if pixels.shape[-1] == 3 else pixels[..., 0] * pixels[..., 3] / 255
    if float(found.max()) == 1:  # numbers of labels
        found = 255 * found
    height, width = found.shape
    if abs(width * lens.height - height * lens.width) > max(width, height, lens.width, lens.height):
        raise ValueError(
            f"The mask {mask} has {width} x {height} pixels, but its photo {path} has {lens.width} x {lens.height}: "
            "make it in the proportions of the photo."
        )
    size = (lens.height, lens.width)
    return functional.interpolate(found[None, None], size, mode="area")[0, 0].round().to(torch.uint8)


def _pixels_of(image: Tensor) -> Tensor:
    """Rounded pixels (H, W, C) of dtype uint8, of an image (C, H, W)."""
    return rearrange(image.round_().clamp_(0, 255).to(torch.uint8), "c h w -> h w c").contiguous()


def remapped(pixels: Tensor, lens: Lens) -> Tensor:
    """The undistorted picture of uint8 pixels (H, W, C)."""
    return _pixels_of(remap(rearrange(pixels, "h w c -> c h w").float(), lens, lens.undistorted()))


def check_image_size(path: str | Path, size: tuple[int, int], lens: Lens) -> None:
    """Raise ValueError unless an image size (width, height) [pixels] matches its lens."""
    if size != (lens.width, lens.height):
        raise ValueError(
            f"The image {path} has {size[0]} x {size[1]} pixels, but its camera has {lens.width} x {lens.height}: "
            "replace it by the image that belongs to the camera, or correct the size in the camera file."
        )


def average_down(image: Tensor, factor: int) -> Tensor:
    """Mean over squares of ``factor`` x ``factor`` pixels; incomplete squares below and on the right are cut off.

    Args:
        image: Floating-point picture, channels first, shape (C, H, W).
        factor: Side of the squares [pixels].

    Returns:
        The smaller picture, shape (C, H // factor, W // factor).
    """
    return functional.avg_pool2d(image[None], factor)[0]


def straight_colors(pixels: Tensor) -> tuple[Tensor, Tensor | None]:
    """Colours and alpha of the pixels that :func:`load_image` returns.

    Args:
        pixels: Dtype uint8, shape (..., 3), or (..., 4) with colours that are multiplied with alpha.

    Returns:
        Colours in 0 to 1 as float32, shape (..., 3), not multiplied with alpha and black where it is 0; alpha, shape
        (..., 1), or None without it. The picture over a background is colours alpha + (1 - alpha) background.

    Example:
        >>> straight_colors(torch.tensor([51, 0, 0, 51], dtype=torch.uint8))
        (tensor([1., 0., 0.]), tensor([0.2000]))
    """
    if pixels.shape[-1] == 3:
        return pixels.float() / 255, None
    values = pixels.float()
    alpha = values[..., 3:]
    return (values[..., :3] / alpha.clamp_min(1)).clamp_max(1), alpha / 255
