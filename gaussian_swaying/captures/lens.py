"""Lenses with radial and tangential distortion, and the pinhole picture after undistortion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
import torch.nn.functional as functional
from torch import Tensor

from gaussian_swaying._checks import check_vector

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


def distort(points: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    r"""Apply Brown-Conrady distortion to ``points`` of a pinhole camera.

    .. math::
        \mathbf{x}_d = (1 + k_1 r^2 + k_2 r^4 + k_3 r^6)\,\mathbf{x} +
        \begin{pmatrix} 2 p_1 x y + p_2 (r^2 + 2 x^2) \\ p_1 (r^2 + 2 y^2) + 2 p_2 x y \end{pmatrix}

    Args:
        points: Points of the image plane at depth 1, shape (..., 2).
        coefficients: k1, k2, p1, p2, k3.

    Returns:
        Distorted points, shape (..., 2).
    """
    k1, k2, p1, p2, k3 = coefficients
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def _derivatives(points: Tensor, coefficients: tuple[float, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Entries xx, xy (= yx) and yy of the Jacobian of :func:`distort`."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * r2 * k3)
    return (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def undistort(points: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Inverse of :func:`distort` by Newton's method.

    Args:
        points: Distorted points of the image plane at depth 1, shape (..., 2).
        coefficients: k1, k2, p1, p2, k3.

    Returns:
        Pinhole points, shape (..., 2).
    """
    solution = points.double()
    for _ in range(20):
        xx, xy, yy = _derivatives(solution, coefficients)
        error = distort(solution, coefficients) - points
        determinant = xx * yy - xy * xy
        step = torch.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], -1)
        solution = solution - step / determinant[..., None]
    residual = (distort(solution, coefficients) - points).abs().amax() if points.numel() else torch.zeros(())
    xx, xy, yy = _derivatives(solution, coefficients)
    if not float(residual) < 1e-6 or not bool(((xx * yy - xy * xy) > 0).all()):
        raise ValueError(
            f"The distortion k1, k2, p1, p2, k3 = {list(coefficients)} cannot be undone because it folds the image: "
            "correct the coefficients, or undistort the images with the tool that found them."
        )
    return solution.to(points.dtype)


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics of an image on disk.

    The centre of the pixel in row i and column j is at (j + 0.5, i + 0.5).

    Attributes:
        fx: Focal length along the rows [pixels].
        fy: Focal length along the columns [pixels].
        cx: Column of the principal point [pixels].
        cy: Row of the principal point [pixels].
        width: Image width [pixels].
        height: Image height [pixels].
        distortion: Brown-Conrady coefficients k1, k2, p1, p2, k3.

    Raises:
        ValueError: If a focal length or a size is not positive, or a number is not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = NO_DISTORTION

    def __post_init__(self) -> None:
        check_vector("distortion", self.distortion, 5)
        check_vector("cx, cy", (self.cx, self.cy), 2)
        for name in ("fx", "fy", "width", "height"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"Expected `{name}` of a lens to be positive and finite, but got {value}.")

    @property
    def distorted(self) -> bool:
        return any(self.distortion)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens for pictures of another size [pixels]."""
        x, y = width / self.width, height / self.height
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height)

    def averaged(self, factor: int) -> Lens:
        """The lens after averaging ``factor`` x ``factor`` pixels into one.

        Rows and columns that do not fill a pixel are cut off at the lower and the right edge.
        """
        width, height = self.width // factor, self.height // factor
        if width == 0 or height == 0:
            raise ValueError(
                f"Cannot make an image of {self.width} x {self.height} pixels {factor} times smaller: "
                "lower `downscale`."
            )
        whole = replace(self, width=width * factor, height=height * factor)
        return whole.resized(width, height)

    def undistorted(self) -> Lens:
        """The pinhole lens with the same focal lengths that covers the largest upright rectangle in the image.

        Every pixel of the new picture is between pixel centres of the old one, so no pixel is made up at the edges.
        With barrel distortion the new picture may be larger than the old one, at most twice.
        """
        return _undistorted(self) if self.distorted else self

    def intrinsics(self) -> Tensor:
        """Matrix with fx, fy, cx, cy [pixels] in float64, shape (3, 3)."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)


@lru_cache(maxsize=1024)  # the images of a capture share a lens or have one each
def _undistorted(lens: Lens) -> Lens:
    focal = torch.tensor([lens.fx, lens.fy], dtype=torch.float64)
    center = torch.tensor([lens.cx, lens.cy], dtype=torch.float64)
    x = torch.linspace(0.5, lens.width - 0.5, lens.width, dtype=torch.float64)
    y = torch.linspace(0.5, lens.height - 0.5, lens.height, dtype=torch.float64)
    edges = {
        "left": torch.stack([x[:1].expand(len(y)), y], -1),
        "right": torch.stack([x[-1:].expand(len(y)), y], -1),
        "top": torch.stack([x, y[:1].expand(len(x))], -1),
        "bottom": torch.stack([x, y[-1:].expand(len(x))], -1),
    }
    seen = {k: undistort((e - center) / focal, lens.distortion) * focal + center for k, e in edges.items()}
    # first and one past the last pixel whose centre is inside, in pixels of the old image
    left = math.ceil(max(float(seen["left"][:, 0].max()), -0.5 * lens.width) - 0.5)
    right = math.floor(min(float(seen["right"][:, 0].min()), 1.5 * lens.width) - 0.5) + 1
    top = math.ceil(max(float(seen["top"][:, 1].max()), -0.5 * lens.height) - 0.5)
    bottom = math.floor(min(float(seen["bottom"][:, 1].min()), 1.5 * lens.height) - 0.5) + 1
    if right - left < 0.2 * lens.width or bottom - top < 0.2 * lens.height:
        raise ValueError(
            f"The distortion k1, k2, p1, p2, k3 = {list(lens.distortion)} leaves {max(right - left, 0)} x "
            f"{max(bottom - top, 0)} of {lens.width} x {lens.height} pixels: correct the coefficients, or "
            "undistort the images with the tool that found them."
        )
    return Lens(lens.fx, lens.fy, lens.cx - left, lens.cy - top, right - left, bottom - top)


def remap(image: Tensor, source: Lens, target: Lens) -> Tensor:
    """Undistort a picture, with bilinear interpolation.

    Args:
        image: Picture taken with ``source``, channels first, floating point, shape (C, H, W).

    Returns:
        The picture, shape (C, ``target.height``, ``target.width``).
    """
    grid = _places(source, target, image.dtype).to(image.device)
    return functional.grid_sample(image[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0]


@lru_cache(maxsize=4)  # the frames of a film share a lens
def _places(source: Lens, target: Lens, dtype: torch.dtype) -> Tensor:
    """Places of the pixels of a pinhole lens in the picture of a distorted one, from -1 to 1, shape (1, H, W, 2)."""
    x = (torch.arange(target.width, dtype=torch.float64) + (0.5 - target.cx)) / target.fx
    y = (torch.arange(target.height, dtype=torch.float64) + (0.5 - target.cy)) / target.fy
    rows, columns = torch.meshgrid(y.to(dtype), x.to(dtype), indexing="ij")
    seen = distort(torch.stack([columns, rows], -1), source.distortion)
    focal = seen.new_tensor([2 * source.fx / source.width, 2 * source.fy / source.height])
    offset = seen.new_tensor([2 * source.cx / source.width - 1, 2 * source.cy / source.height - 1])
    return (seen * focal + offset)[None]
