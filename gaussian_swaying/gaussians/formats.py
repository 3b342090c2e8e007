"""Reading a splat in any format: the one place that knows which file is read how."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gaussian_swaying._ply_table import read_header
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import read_compressed_ply, read_splat
from gaussian_swaying.gaussians.gltf import read_gltf
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.gaussians.sog import read_sog
from gaussian_swaying.gaussians.spz import read_spz


def _read_any_ply(path: Path, sh_degree: int | None = None) -> GaussianCloud:
    fields = {name for element in read_header(path).elements for name, _ in element.fields}
    return read_compressed_ply(path) if "packed_position" in fields else read_ply(path, sh_degree)


READERS: dict[str, Callable[[Path], GaussianCloud]] = {
    ".ply": _read_any_ply,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".json": read_sog,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}
"""Readers by the ending of a file's name."""
READABLE = "3DGS or compressed .ply, .splat, .spz, SOG (.sog, meta.json or lod-meta.json), .glb or .gltf"
"""The same, in words."""


def read_gaussians(path: str | os.PathLike[str], sh_degree: int | None = None) -> GaussianCloud:
    """Read a splat in any supported format: 3DGS .ply, compressed .ply, .splat, .spz, SOG or glTF.

    The ending of the name chooses the format; a file with any other ending is read as a .ply. The content tells whether
    a .ply is compressed.

    Args:
        path: File to read.
        sh_degree: Largest degree of spherical harmonics that is kept; None for all. A large .ply takes less memory so.

    Returns:
        The Gaussians as float32 tensors on the CPU.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be used; the message names the file, the field and the remedy.
        ImportError: If a package is missing that the format needs; the message says how to install it.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower(), _read_any_ply)
    cloud = _read_any_ply(path, sh_degree) if reader is _read_any_ply else reader(path)
    if sh_degree is not None and cloud.sh_degree > sh_degree:
        cloud = replace(cloud, sh=cloud.sh[:, : (sh_degree + 1) ** 2].clone())
    return cloud
