"""Reading and writing the binary .ply files of 3D Gaussian Splatting."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import numpy as np
import torch
from einops import rearrange

from gaussian_swaying._files import atomic
from gaussian_swaying._ply_table import PlyHeader, read_element, read_header
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.patches import smallest_axis_normal

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_MEANS, *_DC, "opacity", *_SCALES, *_QUATS)
FARTHEST = 1e12
"""Largest coordinate of a centre [scene units]: its square is finite in float32, and a grid can count its cells."""
OPAQUE_LOGIT = 16.0  # of an opacity of 1: its sigmoid is 1 - 1.1e-7, the largest opacity below 1 in float32


def read_ply(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read a binary 3D Gaussian Splatting .ply file.

    The layout is that of Kerbl et al. 2023 ("3D Gaussian Splatting for Real-Time Radiance Field Rendering"). Properties
    may be in any order, in either byte order, with or without normals, and with spherical harmonics of degree 0 to 3.
    Normals that are all zero, as most tools write them, are ignored. An opacity of exactly 0 or 1, stored as an
    infinite logit, becomes a logit of -16 or 16; the preview says how many there are.

    Args:
        path: File to read.

    Returns:
        The Gaussians as float32 tensors on the CPU.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not a usable 3DGS file; the message names the file, the field and the remedy.

    Warns:
        UserWarning: Once, naming the properties that were ignored.
    """
    path = Path(path)
    data = read_element(path, read_binary_header(path), "vertex")
    names = data.dtype.names or ()
    if "packed_position" in names:
        raise ValueError(
            f"{path} is a compressed .ply; read it with `read_gaussians`, or export it as an uncompressed 3DGS .ply."
        )
    for name in _REQUIRED:
        if name not in names:
            raise ValueError(f"{path} has no property `{name}`, so it is not a 3DGS file; export it from a 3DGS tool.")
    rest = _rest_names(path, names)
    has_normals = all(name in names for name in _NORMALS)
    known = {*_REQUIRED, *rest, *(_NORMALS if has_normals else ())}
    ignored = [name for name in names if name not in known]
    if ignored:
        warnings.warn(f"{path}: ignored the properties {', '.join(ignored)}.", UserWarning, stacklevel=2)
    if len(data) == 0:
        raise ValueError(f"{path} holds zero Gaussians (element vertex 0); export the scene again.")

    def columns(fields: tuple[str, ...]) -> np.ndarray:
        table = np.empty((len(data), len(fields)), dtype=np.float32)
        for index, field in enumerate(fields):
            with np.errstate(over="ignore"):
                table[:, index] = data[field]
        for index, field in enumerate(fields):
            bad = ~np.isfinite(table[:, index])
            reject(path, bad, f"property `{field}` is NaN or infinite", "remove them or train again")
        return table

    opacities = _read_opacities(path, data)
    means, quats, scales = columns(_MEANS), columns(_QUATS), columns(_SCALES)
    check_places(path, means)
    check_sizes_and_rotations(path, scales, quats)
    sh = columns(_DC)[:, None, :]
    if rest:
        sh = np.concatenate([sh, rearrange(columns(rest), "n (c k) -> n k c", c=3)], axis=1)
    normals = columns(_NORMALS) if has_normals else None
    if normals is not None and not normals.any():
        normals = None
    return GaussianCloud(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(np.ascontiguousarray(sh)),
        normals=None if normals is None else torch.from_numpy(normals),
    )


def write_ply(path: str | os.PathLike[str], cloud: GaussianCloud) -> None:
    """Write Gaussians as a binary little-endian 3DGS .ply file, with the properties in their usual order.

    The file gets its name only when it is complete. Values are stored as float32, so a float32 cloud is read back
    exactly. If the cloud has no normals, those of the smallest axes are written.

    Args:
        path: File to write; an existing one is replaced.
        cloud: Gaussians to write.

    Raises:
        FileNotFoundError: If the folder does not exist.
        ValueError: If the cloud is empty.
    """
    from plyfile import PlyData, PlyElement

    path = Path(path)
    if len(cloud) == 0:
        raise ValueError(f"{path} was not written because the cloud holds zero Gaussians; select at least one.")
    check_folder(path)
    normals = smallest_axis_normal(cloud.quats, cloud.scales) if cloud.normals is None else cloud.normals
    count, rest_count = len(cloud), 3 * (cloud.sh.shape[1] - 1)
    parts = [cloud.means, normals, cloud.sh[:, 0], rearrange(cloud.sh[:, 1:], "n k c -> n (c k)")]
    parts += [cloud.opacities[:, None], cloud.scales, cloud.quats]
    table = torch.cat([part.detach().to("cpu", torch.float32) for part in parts], dim=1).contiguous().numpy()
    rest = tuple(f"f_rest_{index}" for index in range(rest_count))
    names = (*_MEANS, *_NORMALS, *_DC, *rest, "opacity", *_SCALES, *_QUATS)
    rows = table.astype("<f4", copy=False).view([(name, "<f4") for name in names]).reshape(count)
    with atomic(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


def check_folder(path: Path) -> None:
    """Raise FileNotFoundError if the folder of a file that is to be written does not exist."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written because {path.parent} is not a folder; create it first.")


def check_places(path: Path, means: np.ndarray) -> None:
    """Raise ValueError if a finite centre (N, 3) is too far away to compute with."""
    far = (np.abs(means) > FARTHEST).any(axis=1)
    reject(path, far, f"property `x`, `y` or `z` is beyond ±{FARTHEST:g}", "remove them or train again")


def check_sizes_and_rotations(path: Path, scales: np.ndarray, quats: np.ndarray) -> None:
    """Raise ValueError if the logarithm of a size (N, 3) is out of range, or a quaternion (N, 4) is zero."""
    with np.errstate(over="ignore", under="ignore"):
        size = np.exp(scales)
    reject(
        path,
        ((size == 0) | ~np.isfinite(size)).any(axis=1),
        "property `scale_0`, `scale_1` or `scale_2` (a logarithm) gives a size of zero or infinity",
        "remove them or store the logarithm of the size",
    )
    with np.errstate(under="ignore"):
        zero_quats = np.square(quats).sum(axis=1) == 0
    reject(path, zero_quats, "the quaternion `rot_0` to `rot_3` is zero", "remove them or store 1 0 0 0")


def read_binary_header(path: Path) -> PlyHeader:
    """The header from :func:`~gaussian_swaying._ply_table.read_header`; ValueError if the file is text."""
    header = read_header(path)
    if header.order == "":
        raise ValueError(f"{path} is an ASCII .ply (format ascii); export as binary.")
    return header


def _rest_names(path: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    """The f_rest properties in order; ValueError unless their number is that of a degree from 0 to 3."""
    found = {name for name in names if re.fullmatch(r"f_rest_\d+", name)}
    if len(found) not in (0, 9, 24, 45):
        raise ValueError(
            f"{path} has {len(found)} properties `f_rest_*`, but spherical harmonics of degree 0, 1, 2 or 3 have "
            "0, 9, 24 or 45; export it with one of these degrees."
        )
    rest = tuple(f"f_rest_{index}" for index in range(len(found)))
    for name in rest:
        if name not in found:
            raise ValueError(f"{path} has no property `{name}` among its {len(found)} `f_rest_*`; export it again.")
    return rest


def _read_opacities(path: Path, data: np.ndarray) -> np.ndarray:
    """Opacity logits (N,); infinite ones, for opacities of exactly 0 or 1, are made finite."""
    with np.errstate(over="ignore"):
        logits = np.array(data["opacity"], dtype=np.float32)
    reject(path, np.isnan(logits), "property `opacity` is NaN", "remove them or train again")
    infinite = np.isinf(logits)
    logits[infinite] = np.copysign(np.float32(OPAQUE_LOGIT), logits[infinite])
    return logits


def reject(path: Path, bad: np.ndarray, what: str, remedy: str) -> None:
    """Raise ValueError if any Gaussian of the mask (N,) is bad."""
    if bad.any():
        raise ValueError(
            f"{path}: {what} for {int(bad.sum())} of {len(bad)} Gaussians, first at index {int(bad.argmax())}; "
            f"{remedy}."
        )
