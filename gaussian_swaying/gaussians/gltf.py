"""Splats in glTF (.glb, .gltf) by the extension KHR_gaussian_splatting."""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import LARGEST_HEAD, check_regular, parse_json, read_json
from gaussian_swaying.gaussians.cloud import GaussianCloud, joined
from gaussian_swaying.gaussians.harmonics import SH_DC, rotate_sh
from gaussian_swaying.gaussians.packed import check_count, logits, size_logarithms
from gaussian_swaying.gaussians.repair import cloud_of, repaired
from gaussian_swaying.geometry.covariances import covariance, covariance_to_quat_scale, deform_covariance
from gaussian_swaying.geometry.origin import origin_of
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

_EXTENSION = "KHR_gaussian_splatting"
LARGEST = 1 << 32  # bytes of a .glb file
_GLB = struct.Struct("<4sII")  # magic, version, length; then chunks of a length, a kind and data
_CHUNK = struct.Struct("<I4s")
_UNDERSTOOD = (_EXTENSION, "KHR_mesh_quantization")
_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)  # z up to y up
_STEPS = 1 << 22  # opacities in float32 end half of such a step before 0 and 1


def read_gltf(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read the Gaussians of a .glb or .gltf file, with the transformations of its nodes applied: metres, y up.

    All primitives of the scene that have the extension are read. Buffers may be in the file, or in files beside it.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals.
    """
    path = check_regular(path, "the glTF file")
    document = _Document(path)
    found = list(document.primitives())
    if not found:
        raise ValueError(f"{path} has no primitive with `{_EXTENSION}`; export it as Gaussian splats.")
    degrees = [_degree(path, primitive["attributes"]) for primitive, _ in found]
    counts = [document.count(primitive["attributes"]["POSITION"]) for primitive, _ in found]
    width = (max(degrees) + 1) ** 2
    check_count(path, sum(counts), width)
    if not sum(counts):
        raise ValueError(f"{path} holds zero Gaussians; export the scene again.")
    parts = [document.gaussians(*what, width) for what, count in zip(found, counts, strict=True) if count]
    return joined(*parts)


def encode_gltf(cloud: GaussianCloud, rotation: Tensor | None = None, metres_per_unit: float = 1.0) -> bytes:
    """A .glb file in metres with y up; a node moves the Gaussians to the origin that they count from.

    Programs that do not know the extension show points in the colours of degree 0.

    Args:
        rotation: Rotation from scene directions to z up, shape (3, 3); the scene's z is up if None.
        metres_per_unit: Length of a scene unit [m].
    """
    turn = _UPRIGHT if rotation is None else _UPRIGHT @ rotation.to("cpu", torch.float64)
    cloud = _moved(cloud.to("cpu", torch.float32), turn * metres_per_unit, torch.zeros(3, dtype=torch.float64))
    opacity = cloud.opacities.sigmoid()
    shown = (cloud.sh[:, 0] * SH_DC + 0.5).clamp(0, 1)
    linear = torch.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    color = torch.cat([linear, opacity[:, None]], dim=1)
    columns = {
        "POSITION": cloud.means,
        "COLOR_0": (color * 255).round().to(torch.uint8),
        f"{_EXTENSION}:ROTATION": torch.nn.functional.normalize(cloud.quats, dim=-1)[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": cloud.scales.exp(),
        f"{_EXTENSION}:OPACITY": opacity,
    } | {name: cloud.sh[:, index] for index, name in enumerate(_harmonics(cloud.sh_degree))}
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    data, start = list[bytes](), 0
    for column in columns.values():
        array = column.contiguous().detach().numpy()
        whole = array.dtype == np.uint8
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessors.append({"bufferView": len(views), "count": len(cloud), "type": kind})
        accessors[-1] |= {"componentType": 5121, "normalized": True} if whole else {"componentType": 5126}
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": 34962})
        data.append(array.tobytes())
        start += array.nbytes
    accessors[0] |= {"min": cloud.means.amin(0).tolist(), "max": cloud.means.amax(0).tolist()}
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive: dict[str, Any] = {"attributes": {name: index for index, name in enumerate(columns)}, "mode": 0}
    primitive["extensions"] = {_EXTENSION: extension}
    document = {
        "asset": {"version": "2.0", "generator": "gaussian_swaying"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": cloud.origin} if any(cloud.origin) else {"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = _GLB.size + 2 * _CHUNK.size + len(text) + start
    if size >= LARGEST:
        raise ValueError(
            f"A .glb file holds less than 4 GB, but this one would take {size:,} bytes: choose spz or sog."
        )
    head = _GLB.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON") + text + _CHUNK.pack(start, b"BIN\0")
    return head + b"".join(data)


class _Document:
    """A glTF document and its buffers; whatever is missing or wrong in it is a ValueError that names the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._buffers: dict[int, np.ndarray] = {}
        self._spans: dict[int, tuple[int, int, int]] = {}  # buffer, first byte and end of each view
        with path.open("rb") as stream:
            binary = stream.read(4) == b"glTF"
        self.root = self._chunks() if binary else read_json(path, "glTF file")
        if not isinstance(self.root, dict):
            raise self.broken("it is not a table of keys")
        needed = [name for name in self._list(self.root, "extensionsRequired") if name not in _UNDERSTOOD]
        if needed:
            raise ValueError(
                f"{path} requires the extensions {str(needed)[:80]} (`extensionsRequired`); export without."
            )

    def broken(self, what: str) -> ValueError:
        return ValueError(f"{self.path} is not a usable glTF file ({what}); export it again.")

    def _chunks(self) -> Any:
        size = self.path.stat().st_size
        data = np.memmap(self.path, dtype=np.uint8, mode="r")
        if size < _GLB.size + _CHUNK.size:
            raise self.broken(f"it ends after {size} bytes")
        _, version, length = _GLB.unpack(data[: _GLB.size].tobytes())
        if version != 2 or length != size:
            raise self.broken(f"`version` {version} with a `length` of {length:,} bytes, but there are {size:,}")
        start, chunks = _GLB.size, dict[bytes, np.ndarray]()
        while start + _CHUNK.size <= length:
            count, kind = _CHUNK.unpack(data[start : start + _CHUNK.size].tobytes())
            start += _CHUNK.size
            if start + count > length:
                raise self.broken(f"a part of {count:,} bytes is announced, but {length - start:,} follow")
            chunks.setdefault(kind, data[start : start + count])
            start += count
        if start < length:
            raise self.broken(f"{length - start} bytes follow its last part")
        if len(chunks.get(b"JSON", ())) == 0 or len(chunks[b"JSON"]) > LARGEST_HEAD:
            raise self.broken("its JSON is missing or too large")
        if b"BIN\0" in chunks:
            self._buffers[0] = chunks[b"BIN\0"]
        return parse_json(chunks[b"JSON"].tobytes(), "glTF file", self.path)

    # ---- parts of the document

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        entries = self.root.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise self.broken(f"`{kind}` has no entry {str(index)[:20]}")
        if not isinstance(entries[index], dict):
            raise self.broken(f"`{kind}` {index} is no table of keys")
        return entries[index]

    def whole(self, holder: dict[str, Any], name: str, default: int | None = None) -> int:
        value = holder.get(name, default)
        if type(value) is not int or value < 0:
            raise self.broken(f"`{name}` is {str(value)[:20]}")
        return value

    def primitives(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """The primitives with Gaussians in the scene, and the transformation of each, shape (4, 4)."""
        scenes, nodes = self.root.get("scenes"), self.root.get("nodes")
        if scenes:
            first = self.item("scenes", self.whole(self.root, "scene", 0)).get("nodes", [])
        else:
            listed = nodes if isinstance(nodes, list) else []
            below = [self._list(self.item("nodes", index), "children") for index in range(len(listed))]
            first = sorted(set(range(len(listed))) - {child for row in below for child in row if type(child) is int})
        open_, seen = [(index, np.eye(4)) for index in reversed(first if isinstance(first, list) else [])], set()
        while open_:
            index, matrix = open_.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise self.broken(f"node {index} is there twice")
            seen.add(index)
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = matrix @ self._matrix(node)
            open_ += [(child, matrix) for child in reversed(self._list(node, "children"))]
            if "mesh" in node:
                for primitive in self._list(self.item("meshes", node["mesh"]), "primitives"):
                    extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
                    if isinstance(extensions, dict) and _EXTENSION in extensions:
                        self._check_primitive(primitive, extensions[_EXTENSION])
                        yield primitive, matrix

    def _list(self, holder: dict[str, Any], name: str) -> list[Any]:
        value = holder.get(name, [])
        if not isinstance(value, list):
            raise self.broken(f"`{name}` is no list")
        return value

    def _matrix(self, node: dict[str, Any]) -> np.ndarray:
        """Transformation of a node within its parent, shape (4, 4)."""
        defaults = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1], "matrix": [*np.eye(4).flat]}
        values = {}
        for name, default in defaults.items():
            try:
                values[name] = np.array(node.get(name, default), dtype=np.float64)
            except (ValueError, TypeError, OverflowError):
                raise self.broken(f"`{name}` of a node is no list of numbers") from None
            if values[name].shape != (len(default),) or not np.isfinite(values[name]).all():
                raise self.broken(f"`{name}` of a node is not {len(default)} finite numbers")
        if not values["rotation"].any():
            raise self.broken("`rotation` of a node is zero")
        turn = quat_to_rotation(torch.from_numpy(values["rotation"][[3, 0, 1, 2]])).numpy()
        matrix = values["matrix"].reshape(4, 4).T.copy()
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = turn * values["scale"], values["translation"]
        with np.errstate(over="ignore", invalid="ignore"):
            product: np.ndarray = matrix @ own
        return product

    def _check_primitive(self, primitive: dict[str, Any], kind: Any) -> None:
        if not isinstance(kind, dict) or not isinstance(primitive.get("attributes"), dict):
            raise self.broken(f"`{_EXTENSION}` or `attributes` of a primitive is no table of keys")
        mode = primitive.get("mode", 4)
        if mode != 0 or "indices" in primitive:
            raise self.broken(f"`mode` {str(mode)[:20]} of a primitive with Gaussians is not 0, or it has `indices`")
        if kind.get("extensions"):
            names = str(list(kind["extensions"]) if isinstance(kind["extensions"], dict) else kind["extensions"])[:80]
            raise ValueError(f"{self.path} stores its Gaussians by the extensions {names}; export it without them.")
        if kind.get("kernel", "ellipse") != "ellipse":
            raise ValueError(f"{self.path} has Gaussians of the kernel {str(kind['kernel'])[:40]!r}; export `ellipse`.")
        if kind.get("colorSpace") == "lin_rec709_display":
            warnings.warn(
                f"{self.path} has colours in linear light, which are shown as they are: it looks too dark.",
                UserWarning,
                stacklevel=4,
            )

    # ---- numbers

    def count(self, index: Any) -> int:
        return self.whole(self.item("accessors", index), "count")

    def gaussians(self, primitive: dict[str, Any], matrix: np.ndarray, width: int) -> GaussianCloud:
        names, path = primitive["attributes"], self.path
        count = self.count(names["POSITION"])

        def column(name: str, kind: str) -> np.ndarray:
            if name not in names:
                raise ValueError(f"{path} has no attribute `{name}`, so it is not a splat; export it again.")
            return self._accessor(names[name], kind, count, name)[0]

        opacity, steps = self._accessor(names.get(f"{_EXTENSION}:OPACITY"), "SCALAR", count, "OPACITY")
        sizes = column(f"{_EXTENSION}:SCALE", "VEC3")
        scales, others = size_logarithms(sizes, "attribute `SCALE`")
        outside = ~(np.abs(opacity[:, 0] - 0.5) <= 0.501)  # and what is not a number
        others["attribute `OPACITY` is not from 0 to 1 (store the opacity itself, not its logit)"] = outside
        sh = np.zeros((count, width, 3), dtype=np.float32)
        for place, name in enumerate(_harmonics(_degree(path, names))):
            sh[:, place] = column(name, "VEC3")
        cloud = cloud_of(
            path,
            others,
            means=column("POSITION", "VEC3"),
            quats=column(f"{_EXTENSION}:ROTATION", "VEC4")[:, [3, 0, 1, 2]],
            scales=scales,
            opacities=logits(opacity[:, 0], steps),
            sh=sh,
        )
        self._check_turn(matrix)
        moved = _moved(cloud, *map(torch.from_numpy, (matrix[:3, :3].copy(), matrix[:3, 3].copy())))
        return moved if moved is cloud else repaired(path, moved)

    def _check_turn(self, matrix: np.ndarray) -> None:
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        if not (np.isfinite(matrix).all() and lengths.all()):
            raise self.broken("the transformation of a node is singular or infinite")
        turn = matrix[:3, :3] / lengths
        if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            raise ValueError(f"{self.path} shears or mirrors its Gaussians by a node; apply that before the export.")

    def _accessor(self, index: Any, kind: str, count: int, name: str) -> tuple[np.ndarray, int]:
        """Numbers of an accessor as float32, shape (count, width), and the number of their steps from 0 to 1."""
        accessor = self.item("accessors", index)
        number = self.whole(accessor, "componentType")
        if accessor.get("type") != kind or number not in _TYPES or self.count(index) != count:
            raise self.broken(f"attribute `{name}` is not {count:,} of {kind} in a `componentType` that it may have")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"{self.path}: attribute `{name}` is sparse; export the Gaussians without `sparse`.")
        view = self.item("bufferViews", accessor["bufferView"])
        buffer = self._buffer(self.whole(view, "buffer"))
        dtype, width = np.dtype(_TYPES[number]).newbyteorder("<"), _WIDTHS[kind]
        row = width * dtype.itemsize
        stride = self.whole(view, "byteStride", row)
        first, length = self.whole(view, "byteOffset", 0), self.whole(view, "byteLength")
        inner = self.whole(accessor, "byteOffset", 0)
        needed = inner + (stride * (count - 1) + row if count else 0)
        if stride < row or needed > length or first + length > len(buffer):
            raise self.broken(f"attribute `{name}` announces {count:,} rows, but its buffer has {len(buffer):,} bytes")
        if (first + inner) % dtype.itemsize or stride % dtype.itemsize:
            raise self.broken(f"attribute `{name}` has a `byteOffset` or a `byteStride` between two numbers")
        if "byteStride" not in view:
            place = accessor["bufferView"]
            self._spans[place] = (view["buffer"], first, first + length)
            for index, (other, start, end) in self._spans.items():
                if other == view["buffer"] and index != place and start < first + length and first < end:
                    raise self.broken(f"attribute `{name}` has a `byteOffset` within the numbers of another one")
        shared = [
            a for a in self.root["accessors"] if isinstance(a, dict) and a.get("bufferView") == accessor["bufferView"]
        ]
        if length >= needed + stride and len(shared) == 1:
            raise self.broken(
                f"attribute `{name}` has a `count` of {count:,}, but its view has a `byteLength` for more"
            )
        rows = np.ndarray((count, width), dtype, buffer, first + inner, (stride, dtype.itemsize))
        values = rows.astype(np.float32)
        if not accessor.get("normalized") or number == 5126:
            return values, _STEPS
        top = np.iinfo(dtype).max
        return np.maximum(values / np.float32(top), -1), int(top)

    def _buffer(self, index: int) -> np.ndarray:
        entry = self.item("buffers", index)
        announced = self.whole(entry, "byteLength")
        if index not in self._buffers:
            uri = entry.get("uri")
            if not isinstance(uri, str):
                raise self.broken(f"buffer {index} has no data")
            if uri.startswith("data:"):
                try:
                    data = base64.b64decode(uri.partition(",")[2], validate=True)
                except binascii.Error:
                    raise self.broken(f"buffer {index} is not in base64") from None
                self._buffers[index] = np.frombuffer(data, dtype=np.uint8)
            else:
                name = unquote(uri)
                if Path(name).name != name or name in ("", ".", ".."):
                    raise ValueError(f"{self.path} takes its data from {name[:80]!r}; put that file beside it.")
                beside = check_regular(self.path.with_name(name), "the buffer")
                self._buffers[index] = np.fromfile(beside, dtype=np.uint8)
        found = self._buffers[index]
        if not announced <= len(found) < announced + 4:  # padding
            raise self.broken(f"buffer {index} has a `byteLength` of {announced:,}, but its data {len(found):,} bytes")
        return found[:announced]


def _harmonics(degree: int) -> list[str]:
    return [f"{_EXTENSION}:SH_DEGREE_{band}_COEF_{k}" for band in range(degree + 1) for k in range(2 * band + 1)]


def _degree(path: Path, names: dict[str, Any]) -> int:
    if "POSITION" not in names:
        raise ValueError(f"{path} has no attribute `POSITION`, so it is not a splat; export it again.")
    degree = max((band for band in range(4) if any(f":SH_DEGREE_{band}_" in name for name in names)), default=0)
    for name in _harmonics(degree):
        if name not in names:
            raise ValueError(f"{path} has no attribute `{name}`, but others up to degree {degree}; export it again.")
    return degree


def _moved(cloud: GaussianCloud, matrix: Tensor, shift: Tensor) -> GaussianCloud:
    """Gaussians after x -> A x + b; A is a rotation times scales along the axes, in float64."""
    if torch.equal(matrix, torch.eye(3).to(matrix)) and not shift.any():
        return cloud
    sizes = matrix.norm(dim=0)
    turn = matrix / sizes
    places = cloud.means.double() @ matrix.T + (matrix @ torch.tensor(cloud.origin, dtype=torch.float64) + shift)
    origin = origin_of(places.numpy())
    means = (places - torch.tensor(origin)).float()
    if float(sizes.max() / sizes.min()) < 1 + 1e-6:
        quats = rotation_to_quat(turn @ quat_to_rotation(cloud.quats.double()))
        scales = cloud.scales + sizes.mean().log()
    else:
        still = covariance(cloud.quats.double(), cloud.scales.double())
        quats, scales = covariance_to_quat_scale(deform_covariance(matrix, still))
    sh = rotate_sh(cloud.sh.double(), turn)
    return GaussianCloud(means, quats.float(), scales.float(), cloud.opacities, sh.float(), origin=origin)
