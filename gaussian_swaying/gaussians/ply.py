"""Reading and writing the binary .ply files of 3D Gaussian Splatting."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange

from gaussian_swaying._files import atomic
from gaussian_swaying._ply_table import PlyHeader, element_parts, layout, read_header
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.repair import FLAT, check_units, cloud_of
from gaussian_swaying.geometry.patches import smallest_axis_normal

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_MEANS, *_DC, "opacity", *_SCALES[:2], *_QUATS)


def read_ply(path: str | os.PathLike[str], sh_degree: int | None = None) -> GaussianCloud:
    """Read a binary 3D Gaussian Splatting .ply file, in parts: it is never in memory twice.

    The layout is that of Kerbl et al. 2023 ("3D Gaussian Splatting for Real-Time Radiance Field Rendering"). Properties
    may be in any order, in either byte order, with or without normals, and with spherical harmonics of degree 0 to 3.
    Normals that are all zero, as most tools write them, are ignored. An opacity of exactly 0 or 1, stored as an
    infinite logit, becomes a logit of -16 or 16. Without ``scale_2``, as 2DGS writes it, Gaussians are flat.

    Args:
        sh_degree: Largest degree of spherical harmonics that is kept; None for all.

    Returns:
        The Gaussians as float32 tensors on the CPU.
    """
    path = Path(path)
    header = read_binary_header(path)
    kinds, count, _ = layout(path, header, "vertex")
    names = kinds.names or ()
    for name in _REQUIRED:
        if name not in names and "x" in names and not {"scale_0", "f_dc_0", "opacity"} & {*names}:
            raise ValueError(
                f"{path} is a point cloud or a mesh, not a splat (no property `scale_0`, `f_dc_0` or `opacity`): train "
                "one from photos with `gaussian-swaying train`."
            )
        if name not in names:
            raise ValueError(f"{path} has no property `{name}`, so it is not a 3DGS file; export it from a 3DGS tool.")
    rest = _rest_names(path, names)
    has_normals = all(name in names for name in _NORMALS)
    scales = [name for name in _SCALES if name in names]
    known = {*_REQUIRED, *scales, *rest, *(_NORMALS if has_normals else ())}
    ignored = [name for name in names if name not in known]
    if ignored:
        warnings.warn(f"{path}: ignored the properties {', '.join(ignored)}.", UserWarning, stacklevel=2)
    for name in known:
        if kinds[name].kind != "f":
            raise ValueError(f"{path}: property `{name}` is a whole number; export it as float.")
    if count == 0:
        raise ValueError(f"{path} holds zero Gaussians (element vertex 0); export the scene again.")
    per_channel = len(rest) // 3
    kept = per_channel if sh_degree is None else min(per_channel, (sh_degree + 1) ** 2 - 1)
    columns = {"opacity": ("opacities", 0)}  # of each property: a table, and a column of it
    for table, fields in (("means", _MEANS), ("quats", _QUATS), ("scales", scales), ("normals", _NORMALS)):
        if table != "normals" or has_normals:
            columns |= {field: (table, k) for k, field in enumerate(fields)}
    columns |= {field: ("sh", k) for k, field in enumerate(_DC)}
    for channel in range(3):
        columns |= {rest[channel * per_channel + k]: ("sh", 3 + 3 * k + channel) for k in range(kept)}
    of_table = [table for table, _ in columns.values()]
    doubles = {table for field, (table, _) in columns.items() if table == "means" and kinds[field].itemsize > 4}
    tables: dict[str, Any] = {
        name: np.empty((count, of_table.count(name)), dtype=np.float64 if name in doubles else np.float32)
        for name in dict.fromkeys(of_table)
    }
    first = 0
    with np.errstate(over="ignore"):
        for part in element_parts(path, header, "vertex"):
            for field, (table, k) in columns.items():
                tables[table][first : first + len(part), k] = part[field]
            first += len(part)
    if "scale_2" not in names:
        thin = tables["scales"].max(1, keepdims=True) + np.float32(FLAT)
        tables["scales"] = np.concatenate([tables["scales"], thin], 1)
    if has_normals and not tables["normals"].any():
        del tables["normals"]
    tables |= {"opacities": tables["opacities"][:, 0], "sh": tables["sh"].reshape(count, 1 + kept, 3)}
    cloud = cloud_of(path, **tables)
    check_units(path, cloud)
    return cloud


def write_ply(path: str | os.PathLike[str], cloud: GaussianCloud) -> None:
    """Write Gaussians as a binary little-endian 3DGS .ply file, with the properties in their usual order.

    The file gets its name only when it is complete. Values are stored as float32, so a float32 cloud is read back
    exactly; centres that count from an origin are stored as doubles. If the cloud has no normals, those of the smallest
    axes are written.

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
    if any(cloud.origin):
        rows = rows.astype([(name, "<f8" if name in _MEANS else "<f4") for name in names])
        for axis, shift in zip(_MEANS, cloud.origin, strict=True):
            rows[axis] += shift
    with atomic(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


def check_folder(path: Path) -> None:
    """Raise an error if the folder of a file that is to be written does not exist, or the file is a folder itself."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a file inside it.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written because {path.parent} is not a folder; create it first.")


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
