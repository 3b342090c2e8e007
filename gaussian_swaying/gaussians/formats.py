"""Reading a splat in any format: the one place that knows which file is read how."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gaussian_swaying._inputs import check_regular
from gaussian_swaying._ply_table import read_header
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import read_compressed_ply, read_splat
from gaussian_swaying.gaussians.gltf import read_gltf
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.gaussians.sog import read_sog
from gaussian_swaying.gaussians.spz import read_spz

_BEGINNINGS = {
    b"ply\n": (".ply",),
    b"ply\r": (".ply",),
    b"ngsp": (".spz",),
    b"\x1f\x8b": (".spz",),
    b"pk\3\4": (".sog",),
    b"gltf": (".glb", ".gltf"),
}
"""What a file begins with, in small letters, and the endings of its name."""
_PAGES = (b"<!doctype", b"<html", b"<?xml")


def _check_beginning(path: Path) -> None:
    """Raise ValueError if the content is plainly another than the name says."""
    with check_regular(path, "the splat").open("rb") as stream:
        start = stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if start.startswith(_PAGES):
        raise ValueError(f"{path} is a web page, such as an error of a server, and no splat: download the file again.")
    if start.startswith(b"version https://git-lfs"):
        raise ValueError(f"{path} is a pointer of Git LFS, not the splat itself: run `git lfs pull` in its repository.")
    for begins, endings in _BEGINNINGS.items():
        other = path.suffix.lower() not in endings and (path.suffix.lower() in READERS or endings != (".ply",))
        if start.startswith(begins) and other:
            raise ValueError(f"{path} begins as a {endings[0]} file: if it is one, rename it to end in {endings[0]}.")


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
    _check_beginning(path)
    reader = READERS.get(path.suffix.lower(), _read_any_ply)
    cloud = _read_any_ply(path, sh_degree) if reader is _read_any_ply else reader(path)
    if sh_degree is not None and cloud.sh_degree > sh_degree:
        cloud = replace(cloud, sh=cloud.sh[:, : (sh_degree + 1) ** 2].clone())
    return cloud
