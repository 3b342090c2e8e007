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
from gaussian_swaying._ply_table import PlyHeader, element_parts, layout, read_header
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


def read_ply(path: str | os.PathLike[str], sh_degree: int | None = None) -> GaussianCloud:
    """Read a binary 3D Gaussian Splatting .ply file, in parts: it is never in memory twice.

    The layout is that of Kerbl et al. 2023 ("3D Gaussian Splatting for Real-Time Radiance Field Rendering"). Properties
    may be in any order, in either byte order, with or without normals, and with spherical harmonics of degree 0 to 3.
    Normals that are all zero, as most tools write them, are ignored. An opacity of exactly 0 or 1, stored as an
    infinite logit, becomes a logit of -16 or 16; the preview says how many there are.

    Args:
        path: File to read.
        sh_degree: Largest degree of spherical harmonics that is kept; None for all.

    Returns:
        The Gaussians as float32 tensors on the CPU.
    """
    path = Path(path)
    header = read_binary_header(path)
    kinds, count, _ = layout(path, header, "vertex")
    names = kinds.names or ()
    for name in _REQUIRED:
        if name not in names:
            raise ValueError(f"{path} has no property `{name}`, so it is not a 3DGS file; export it from a 3DGS tool.")
    rest = _rest_names(path, names)
    has_normals = all(name in names for name in _NORMALS)
    known = {*_REQUIRED, *rest, *(_NORMALS if has_normals else ())}
    ignored = [name for name in names if name not in known]
    if ignored:
        warnings.warn(f"{path}: ignored the properties {', '.join(ignored)}.", UserWarning, stacklevel=2)
    if count == 0:
        raise ValueError(f"{path} holds zero Gaussians (element vertex 0); export the scene again.")
    per_channel = len(rest) // 3
    kept = per_channel if sh_degree is None else min(per_channel, (sh_degree + 1) ** 2 - 1)
    columns = {"opacity": ("opacities", 0)}  # of each property: a table, and a column of it
    for table, fields in (("means", _MEANS), ("quats", _QUATS), ("scales", _SCALES), ("normals", _NORMALS)):
        if table != "normals" or has_normals:
            columns |= {field: (table, k) for k, field in enumerate(fields)}
    columns |= {field: ("sh", k) for k, field in enumerate(_DC)}
    for channel in range(3):
        columns |= {rest[channel * per_channel + k]: ("sh", 3 + 3 * k + channel) for k in range(kept)}
    of_table = [table for table, _ in columns.values()]
    tables = {name: np.empty((count, of_table.count(name)), dtype=np.float32) for name in dict.fromkeys(of_table)}
    first = 0
    with np.errstate(over="ignore"):
        for part in element_parts(path, header, "vertex"):
            for field, (table, k) in columns.items():
                tables[table][first : first + len(part), k] = part[field]
            first += len(part)
    opacities = _finite_opacities(path, tables["opacities"][:, 0])
    for field, (table, k) in columns.items():
        if table != "opacities":
            bad = ~np.isfinite(tables[table][:, k])
            reject(path, bad, f"property `{field}` is NaN or infinite", "remove them or train again")
    check_places(path, tables["means"])
    check_sizes_and_rotations(path, tables["scales"], tables["quats"])
    normals = tables.get("normals")
    if normals is not None and not normals.any():
        normals = None
    return GaussianCloud(
        means=torch.from_numpy(tables["means"]),
        quats=torch.from_numpy(tables["quats"]),
        scales=torch.from_numpy(tables["scales"]),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(tables["sh"].reshape(count, 1 + kept, 3)),
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
    """Raise an error if the folder of a file that is to be written does not exist, or the file is a folder itself."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a file inside it.")
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


def _finite_opacities(path: Path, logits: np.ndarray) -> np.ndarray:
    """Opacity logits (N,); infinite ones, for opacities of exactly 0 or 1, are made finite."""
    reject(path, np.isnan(logits), "property `opacity` is NaN", "remove them or train again")
    infinite = np.isinf(logits)
    logits[infinite] = np.copysign(np.float32(OPAQUE_LOGIT), logits[infinite])
    return np.ascontiguousarray(logits)


def reject(path: Path, bad: np.ndarray, what: str, remedy: str) -> None:
    """Raise ValueError if any Gaussian of the mask (N,) is bad."""
    if bad.any():
        raise ValueError(
            f"{path}: {what} for {int(bad.sum())} of {len(bad)} Gaussians, first at index {int(bad.argmax())}; "
            f"{remedy}."
        )
