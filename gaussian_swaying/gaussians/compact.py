"""Splats in the small formats of web viewers: PlayCanvas' compressed .ply and antimatter15's .splat."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from einops import rearrange

from gaussian_swaying._inputs import check_regular
from gaussian_swaying._ply_table import read_element
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.packed import logits, size_logarithms, with_largest
from gaussian_swaying.gaussians.ply import read_binary_header
from gaussian_swaying.gaussians.repair import cloud_of

CHUNK = 256  # number of Gaussians with a common range of values in a compressed .ply
_SPLAT = np.dtype([("means", "<f4", 3), ("sizes", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def read_splat(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read a .splat file: 32 bytes for each Gaussian, colours of degree 0.

    Colours, opacities and quaternions have 8 bits; an opacity at the end of its range is moved inwards by half a step.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals.
    """
    path = check_regular(path, "the .splat file")
    size = path.stat().st_size
    if size == 0 or size % _SPLAT.itemsize:
        raise ValueError(
            f"{path} has {size} bytes, but a .splat file holds 32 for each Gaussian; copy or export it again."
        )
    rows = np.fromfile(path, dtype=_SPLAT)
    scales, others = size_logarithms(rows["sizes"], "the size")
    quats = (rows["quats"].astype(np.float32) - 128) / 128
    return _colored(path, rows["means"], scales, quats, rows["rgba"] / np.float32(255), others=others)


def read_compressed_ply(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read a compressed .ply, as SuperSplat and :func:`~gaussian_swaying.gaussians.formats.export_cloud` write it.

    Each chunk of 256 Gaussians has ranges for centres, sizes and, in newer files, colours; within them centres and
    sizes have 11, 10 and 11 bits, colours and opacities 8. Quaternions store their three smaller components with 10
    bits, harmonics 8 bits from -4 to 4.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals.
    """
    path = Path(path)
    header = read_binary_header(path)
    held = {element.name for element in header.elements}
    vertices = read_element(path, header, "vertex")
    count = len(vertices)
    if count == 0:
        raise ValueError(f"{path} holds zero Gaussians (element vertex 0); export the scene again.")
    others = ", ".join(sorted({*(vertices.dtype.names or ())} - {*_PACKED}))
    if others:
        raise ValueError(f"{path} has the properties {others[:80]}, which no compressed .ply has; export it again.")
    for name in _PACKED:
        if name not in (vertices.dtype.names or ()):
            raise ValueError(f"{path} has no property `{name}`, so it is not a compressed .ply; export it again.")
        if vertices.dtype[name].kind not in "iu":
            raise ValueError(f"{path}: property `{name}` is not a whole number; export the file again.")
    chunks: Any = read_element(path, header, "chunk") if "chunk" in held else np.empty(0)
    if len(chunks) != -(-count // CHUNK):
        raise ValueError(
            f"{path} has {len(chunks)} chunks, which are not those of {count} Gaussians (element `vertex`) in chunks "
            f"of {CHUNK}; export it again."
        )
    chunk_of = np.arange(count) // CHUNK

    def within(share: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        """Shares (N, 3) of the range of each Gaussian's chunk."""
        for name in (f"{end}_{axis}" for end in ("min", "max") for axis in names):
            if name not in chunks.dtype.names or chunks.dtype[name].kind != "f":
                raise ValueError(f"{path} has no property `{name}` in its chunks; export it again.")
        low, high = (
            np.stack([chunks[f"{end}_{axis}"][chunk_of] for axis in names], -1).astype(np.float64)
            for end in ("min", "max")
        )
        with np.errstate(invalid="ignore", over="ignore"):
            return np.where(np.isneginf(low), low, low + share * (high - low))

    position, rotation, scale, color = (vertices[name].astype(np.int64) & 0xFFFFFFFF for name in _PACKED)
    means = within(_three(position, (11, 10, 11)), ("x", "y", "z"))
    scales = within(_three(scale, (11, 10, 11)), ("scale_x", "scale_y", "scale_z"))
    rgba = np.stack([(color >> shift & 255) / 255 for shift in (24, 16, 8, 0)], -1)
    if "min_r" in chunks.dtype.names:
        rgba[:, :3] = within(rgba[:, :3], ("r", "g", "b"))
    rest = _harmonics(path, read_element(path, header, "sh"), count) if "sh" in held else None
    return _colored(path, means, scales, _quats(rotation), rgba, rest)


def _three(packed: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
    """Three numbers in [0, 1] packed into each whole number, the first in the highest bits; shape (N, 3)."""
    shares, shift = [], sum(bits)
    for width in bits:
        shift -= width
        shares.append((packed >> shift & (1 << width) - 1) / ((1 << width) - 1))
    return np.stack(shares, -1)


def _quats(packed: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz from the place of the largest component (2 bits) and the others (10 bits each)."""
    return with_largest((_three(packed, (10, 10, 10)) - 0.5) * np.sqrt(2), packed >> 30 & 3)


def _harmonics(path: Path, rows: np.ndarray, count: int) -> np.ndarray:
    """Harmonics beyond degree 0, shape (N, K - 1, 3), stored channel by channel."""
    names = [f"f_rest_{index}" for index in range(len(rows.dtype.names or ()))]
    if len(rows) != count or len(names) not in (9, 24, 45) or set(names) != set(rows.dtype.names or ()):
        raise ValueError(
            f"{path}: the element `sh` does not hold 9, 24 or 45 properties `f_rest_*` for each of {count} Gaussians; "
            "export it again."
        )
    table = np.stack([rows[name] for name in names], -1).astype(np.float32)
    values: np.ndarray = ((table + 0.5) / 256 - 0.5) * 8
    return rearrange(values, "n (c k) -> n k c", c=3)


def _colored(
    path: Path,
    means: np.ndarray,
    scales: np.ndarray,
    quats: np.ndarray,
    rgba: np.ndarray,
    rest: np.ndarray | None = None,
    others: dict[str, np.ndarray] | None = None,
) -> GaussianCloud:
    """A cloud from colours and opacities (N, 4) as displayed, from 0 to 1 in steps of 1/255."""
    base = (rgba[:, None, :3] - 0.5) / SH_DC
    sh = base if rest is None else np.concatenate([base, rest], 1)
    return cloud_of(path, others, means=means, quats=quats, scales=scales, opacities=logits(rgba[:, 3], 255), sh=sh)
