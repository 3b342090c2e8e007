"""Splats in glTF (.glb, .gltf) by the extension KHR_gaussian_splatting."""

from __future__ import annotations

import base64
import functools
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
from gaussian_swaying.gaussians.bones import Bones
from gaussian_swaying.gaussians.cloud import GaussianCloud, joined
from gaussian_swaying.gaussians.harmonics import SH_DC, rotate_sh
from gaussian_swaying.gaussians.packed import check_count, logits, size_logarithms, usable
from gaussian_swaying.gaussians.repair import cloud_of, repaired
from gaussian_swaying.geometry.covariances import covariance, covariance_to_quat_scale, deform_covariance
from gaussian_swaying.geometry.origin import origin_of
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

_EXTENSION = "KHR_gaussian_splatting"
LARGEST = 1 << 32  # bytes of a .glb file
_GLB = struct.Struct("<4sII")  # magic, version, length; then chunks of a length, a kind and data
_CHUNK = struct.Struct("<I4s")
_UNDERSTOOD = (_EXTENSION, "KHR_mesh_quantization")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)  # z up to y up
_RECTANGLES = 4000  # of a mesh in the place of Gaussians, at most
_UNLIT = {"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
_STEPS = 1 << 22  # opacities in float32 end half of such a step before 0 and 1


def read_gltf(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read the Gaussians of a .glb or .gltf file, with the transformations of its nodes applied: metres, y up.

    All primitives of the scene that have the extension are read. Buffers may be in the file, or in files beside it.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals.
    """
    path = check_regular(path, "the glTF file")
    with usable(path, "glTF file"):
        root, binary = _opened(path)
        needed = [name for name in root.get("extensionsRequired", []) if name not in _UNDERSTOOD]
        if needed:
            raise ValueError(
                f"{path} requires the extensions {str(needed)[:80]} (`extensionsRequired`); export without."
            )
        found = list(_primitives(path, root))
        if not found:
            raise ValueError(f"{path} has no primitive with `{_EXTENSION}`; export it as Gaussian splats.")
        names = [primitive["attributes"] for primitive, _ in found]
        counts = [root["accessors"][attributes["POSITION"]]["count"] for attributes in names]
        width = (max(map(_degree, names)) + 1) ** 2
        check_count(path, sum(counts), width)
        if not sum(counts):
            raise ValueError(f"{path} holds zero Gaussians; export the scene again.")
        buffers = functools.cache(functools.partial(_buffer, path, root, binary))
        read = functools.partial(_numbers, root, buffers)
        parts = zip(names, found, counts, strict=True)
        return joined(*(_gaussians(path, read, own, matrix, width) for own, (_, matrix), count in parts if count))


def encode_gltf(cloud: GaussianCloud, rotation: Tensor | None = None, metres_per_unit: float = 1.0) -> bytes:
    """A .glb file in metres with y up; a node moves the Gaussians to the origin that they count from.

    Programs that do not know the extension show points in the colours of degree 0.

    Args:
        rotation: Rotation from scene directions to z up, shape (3, 3); the scene's z is up if None.
        metres_per_unit: Length of a scene unit [m].

    Returns:
        The content of the file.
    """
    turn = _UPRIGHT if rotation is None else _UPRIGHT @ rotation.to("cpu", torch.float64)
    cloud = _moved(cloud.to("cpu", torch.float32), turn * metres_per_unit, torch.zeros(3, dtype=torch.float64))
    file = _Glb()
    columns = {
        "POSITION": file.add(cloud.means, bounds=True),
        "COLOR_0": file.add(_shown_color(cloud), normalized=True),
        f"{_EXTENSION}:ROTATION": file.add(torch.nn.functional.normalize(cloud.quats, dim=-1)[:, [1, 2, 3, 0]]),
        f"{_EXTENSION}:SCALE": file.add(cloud.scales.exp()),
        f"{_EXTENSION}:OPACITY": file.add(cloud.opacities.sigmoid()),
    } | {name: file.add(cloud.sh[:, index]) for index, name in enumerate(_harmonics(cloud.sh_degree))}
    node: dict[str, Any] = {"mesh": 0, "translation": cloud.origin} if any(cloud.origin) else {"mesh": 0}
    return file.encode([_splats(columns)], [_EXTENSION], nodes=[node], scenes=[{"nodes": [0]}])


def encode_skinned_gltf(
    cloud: GaussianCloud, bones: Bones, fps: float, rotation: Tensor | None = None, metres_per_unit: float = 1.0,
    proxy: bool = False,
) -> bytes:  # fmt: skip
    """A .glb file whose Gaussians move with the joints of a skin, in the animation ``wind``; without harmonics above 0.

    Positions and sizes have 16 bits, rotations 8. What follows the first bone alone is a mesh without a skin. Programs
    that do not know skins show the Gaussians at rest.

    Args:
        cloud: The Gaussians at rest.
        bones: What moves them, in the units and axes of the scene.
        fps: Frames per second.
        rotation: As for :func:`encode_gltf`.
        metres_per_unit: As for :func:`encode_gltf`.
        proxy: Whether to write, instead of the Gaussians, coloured rectangles in the places of some of them, which move
            in programs that know skins but no Gaussians.

    Returns:
        The content of the file.
    """
    turn = _UPRIGHT if rotation is None else _UPRIGHT @ rotation.to("cpu", torch.float64)
    matrix, origin = turn * metres_per_unit, torch.tensor(cloud.origin, dtype=torch.float64)
    cloud = _moved(cloud.to("cpu", torch.float32), matrix, torch.zeros(3, dtype=torch.float64))
    low, high = cloud.means.double().aminmax(dim=0)
    half = 1.0 if proxy else max(0.5 * float((high - low).max()), float(cloud.scales.max().exp()))
    middle = torch.zeros(3, dtype=torch.float64) if proxy else 0.5 * (low + high)
    centres = (bones.centres + origin) @ matrix.T - torch.tensor(cloud.origin, dtype=torch.float64)
    places = centres + bones.shifts @ matrix.T
    turns = rotation_to_quat(turn @ quat_to_rotation(bones.quats) @ turn.T)[..., [1, 2, 3, 0]]
    bind = torch.eye(4, dtype=torch.float64).repeat(len(centres), 1, 1)
    bind[:, :3, :3] *= half
    bind[:, :3, 3] = middle - centres
    file = _Glb()
    weight = (bones.weight * 255).round()
    weight[torch.arange(len(weight)), weight.argmax(1)] += 255 - weight.sum(1)  # of sum one

    def joints(part: Tensor) -> dict[str, int]:
        own = weight[part].to(torch.uint8)
        return {"JOINTS_0": file.add(bones.index[part].to(torch.uint8)), "WEIGHTS_0": file.add(own, normalized=True)}

    if proxy:
        part, corners = _rectangles(cloud)
        shown = _shown_color(cloud.select(part))
        columns = {"POSITION": file.add(corners, bounds=True), "COLOR_0": file.add(shown, normalized=True)}
        meshes = [{"attributes": columns | joints(part), "material": 0}]
    else:
        still = (weight * (bones.index == 0)).sum(1) == 255
        meshes = [_splats(_packed(file, cloud.select(~still), middle, half) | joints(~still))]
        meshes += [_splats(_packed(file, cloud.select(still), middle, half))] if bool(still.any()) else []
    count, frames = len(centres), len(bones.quats)
    inverse = file.add(bind.mT.reshape(count, 16).float(), vertex=False)
    times = file.add(torch.arange(frames) / fps, vertex=False, bounds=True)
    samplers, channels = list[dict[str, Any]](), list[dict[str, Any]]()
    for joint in range(1, count):  # the first one stays
        for path, values in (("translation", places[:, joint].float()), ("rotation", turns[:, joint].float())):
            samplers.append({"input": times, "output": file.add(values, vertex=False)})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": joint + 2, "path": path}})
    nodes: list[dict[str, Any]] = [{"translation": place} for place in places[0].tolist()]
    root = {"children": [*range(2, count + 2)], **({"translation": cloud.origin} if any(cloud.origin) else {})}
    place = {"scale": [half] * 3, "translation": (middle + torch.tensor(cloud.origin, dtype=torch.float64)).tolist()}
    nodes = [{"mesh": 0, "skin": 0, **place}, root, *nodes, *({"mesh": k, **place} for k in range(1, len(meshes)))]
    parts: dict[str, Any] = {"materials": [_UNLIT]} if proxy else {}
    return file.encode(
        meshes,
        ["KHR_materials_unlit"] if proxy else [_EXTENSION, "KHR_mesh_quantization"],
        nodes=nodes,
        scenes=[{"nodes": [0, 1, *range(count + 2, len(nodes))]}],
        skins=[{"joints": [*range(2, count + 2)], "skeleton": 1, "inverseBindMatrices": inverse}],
        animations=[{"name": "wind", "samplers": samplers, "channels": channels}],
        **parts,
    )


def _packed(file: _Glb, cloud: GaussianCloud, middle: Tensor, half: float) -> dict[str, int]:
    """The Gaussians in few bits, within a box of half the size ``half`` around ``middle``."""
    quats = torch.nn.functional.normalize(cloud.quats, dim=-1)[:, [1, 2, 3, 0]]
    return {
        "POSITION": file.add(_steps((cloud.means.double() - middle) / half, 32767), normalized=True, bounds=True),
        f"{_EXTENSION}:ROTATION": file.add(_steps(quats, 127), normalized=True),
        f"{_EXTENSION}:SCALE": file.add(_steps(cloud.scales.double().exp() / half, 32767), normalized=True),
        f"{_EXTENSION}:OPACITY": file.add((cloud.opacities.sigmoid() * 255).round().to(torch.uint8), normalized=True),
        _harmonics(0)[0]: file.add(cloud.sh[:, 0]),
    }


def _rectangles(cloud: GaussianCloud) -> tuple[Tensor, Tensor]:
    """Two triangles for the most visible Gaussian of each cell: whose they are (M,), and their corners (M, 3)."""
    sizes, axis = cloud.scales.exp().topk(2)
    order = (cloud.opacities.sigmoid() * sizes.prod(1)).argsort(descending=True)
    means, cell = cloud.means[order].double().numpy(), float(sizes.median())
    while True:
        first = np.unique(np.floor(means / cell), axis=0, return_index=True)[1]
        if len(first) <= _RECTANGLES:
            break
        cell *= 1.2
    kept = order[torch.from_numpy(first)]
    own, longer = quat_to_rotation(cloud.quats[kept]), sizes[kept, 0].clamp_min(1e-30)
    sides = own.gather(2, axis[kept, None].expand(-1, 3, -1)) * sizes[kept, None]
    sides = sides * (0.6 * cell / longer).clamp_min(1.5)[:, None, None]  # so that neighbours meet
    signs = sides.new_tensor([[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]])
    corners = cloud.means[kept, None] + (sides[:, None] @ signs[..., None])[..., 0]
    return kept.repeat_interleave(6), corners.flatten(0, 1)


def _steps(values: Tensor, top: int) -> Tensor:
    """Numbers from -1 to 1 in whole steps."""
    return (values * top).round().clamp(-top, top).to(torch.int16 if top > 127 else torch.int8)


def _shown_color(cloud: GaussianCloud) -> Tensor:
    """The colours of degree 0 in linear light, and opacities, for programs that show points."""
    shown = (cloud.sh[:, 0] * SH_DC + 0.5).clamp(0, 1)
    linear = torch.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    return (torch.cat([linear, cloud.opacities.sigmoid()[:, None]], dim=1) * 255).round().to(torch.uint8)


def _splats(columns: dict[str, int]) -> dict[str, Any]:
    """The primitive of Gaussians with these accessors."""
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    return {"attributes": columns, "mode": 0, "extensions": {_EXTENSION: extension}}


class _Glb:
    """A .glb file that is being made."""

    def __init__(self) -> None:
        self.accessors, self.views, self.data, self.size = (
            list[dict[str, Any]](),
            list[dict[str, Any]](),
            list[bytes](),
            0,
        )

    def add(self, column: Tensor, *, normalized: bool = False, bounds: bool = False, vertex: bool = True) -> int:
        """Add the numbers of an accessor (N,) or (N, K), in rows of whole four bytes, and return its place."""
        array = column.contiguous().detach().numpy()
        rows = array.reshape(len(array), -1)
        stride = -(-rows.shape[1] * rows.itemsize // 4) * 4
        kind = {1: "SCALAR", 16: "MAT4"}.get(rows.shape[1], f"VEC{rows.shape[1]}")
        code = next(code for code, name in _TYPES.items() if np.dtype(name) == rows.dtype)
        accessor = {"bufferView": len(self.views), "count": len(rows), "type": kind, "componentType": code}
        accessor |= {"normalized": True} if normalized else {}
        accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()} if bounds else {}
        padded = np.zeros((len(rows), stride), np.uint8)
        padded[:, : rows.shape[1] * rows.itemsize] = rows.view(np.uint8)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.size, "byteLength": padded.nbytes}
        view |= {"target": 34962} if vertex else {}
        view |= {"byteStride": stride} if vertex and stride != rows.shape[1] * rows.itemsize else {}
        self.accessors.append(accessor)
        self.views.append(view)
        self.data.append(padded.tobytes())
        self.size += padded.nbytes
        return len(self.accessors) - 1

    def encode(self, primitives: list[dict[str, Any]], used: list[str], **parts: Any) -> bytes:
        """The file of meshes of one primitive each, with extensions, and further parts of the document."""
        required = [name for name in used if name == "KHR_mesh_quantization"]
        document = {
            "asset": {"version": "2.0", "generator": "gaussian_swaying"},
            "extensionsUsed": used,
            **({"extensionsRequired": required} if required else {}),
            "scene": 0,
            **parts,
            "meshes": [{"primitives": [primitive]} for primitive in primitives],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.size}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = _GLB.size + 2 * _CHUNK.size + len(text) + self.size
        if size >= LARGEST:
            raise ValueError(
                f"A .glb file holds less than 4 GB, but this one would take {size:,} bytes: choose spz or sog."
            )
        head = _GLB.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON") + text
        return head + _CHUNK.pack(self.size, b"BIN\0") + b"".join(self.data)


def _opened(path: Path) -> tuple[dict[str, Any], np.ndarray]:
    with path.open("rb") as stream:
        if stream.read(4) != b"glTF":
            return read_json(path, "glTF file"), np.empty(0, np.uint8)
    data, size = np.memmap(path, dtype=np.uint8, mode="r"), path.stat().st_size
    _, version, length = _GLB.unpack(data[: _GLB.size].tobytes())
    if version != 2 or length != size:
        raise ValueError(f"`version` {version} with a `length` of {length:,} bytes, but there are {size:,}")
    chunks, start = list[np.ndarray](), _GLB.size
    while start + _CHUNK.size <= size and len(chunks) < 2:  # the document and the data
        count, _ = _CHUNK.unpack(data[start : start + _CHUNK.size].tobytes())
        start += _CHUNK.size + count
        if start > size:
            raise ValueError(f"a part of {count:,} bytes is announced, but the file ends before")
        chunks.append(data[start - count : start])
    if len(chunks[0]) > LARGEST_HEAD:
        raise ValueError("its JSON is too large")
    return parse_json(chunks[0].tobytes(), "glTF file", path), chunks[-1]


def _primitives(path: Path, root: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The primitives with Gaussians in the scene, and the transformation of each, shape (4, 4)."""
    nodes = root["nodes"]
    if root.get("scenes"):
        first = root["scenes"][root.get("scene", 0)]["nodes"]
    else:
        first = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
    waiting, seen = [(index, np.eye(4)) for index in reversed(first)], set[int]()
    while waiting:
        index, matrix = waiting.pop()
        node = nodes[index]
        if index in seen:
            raise ValueError(f"node {index} is there twice")
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = matrix @ _matrix(node)
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]
        for primitive in root["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            kind = primitive.get("extensions", {}).get(_EXTENSION)
            if kind is None:
                continue
            if primitive.get("mode", 4) != 0 or "indices" in primitive:
                raise ValueError(f"`mode` {primitive.get('mode', 4)} of Gaussians is not 0, or they have `indices`")
            if kind.get("extensions"):
                raise ValueError(
                    f"{path} stores its Gaussians by the extensions {str(list(kind['extensions']))[:80]}; export it "
                    "without them."
                )
            if kind.get("kernel", "ellipse") != "ellipse":
                raise ValueError(f"{path} has Gaussians of the kernel {str(kind['kernel'])[:40]!r}; export `ellipse`.")
            if kind.get("colorSpace") == "lin_rec709_display":
                told = f"{path} has colours in linear light, which are shown as they are: it looks too dark."
                warnings.warn(told, UserWarning, stacklevel=3)
            yield primitive, matrix


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Transformation of a node within its parent, shape (4, 4)."""
    turn = quat_to_rotation(torch.tensor(node.get("rotation", [0, 0, 0, 1]), dtype=torch.float64)[[3, 0, 1, 2]])
    own = np.eye(4)
    own[:3, :3], own[:3, 3] = turn.numpy() * node.get("scale", [1, 1, 1]), node.get("translation", [0, 0, 0])
    product: np.ndarray = np.array(node.get("matrix", np.eye(4).ravel()), dtype=np.float64).reshape(4, 4).T @ own
    return product


def _gaussians(path: Path, read: Any, names: dict[str, Any], matrix: np.ndarray, width: int) -> GaussianCloud:
    """The Gaussians of a primitive.

    Args:
        read: Gives the numbers of an accessor, see :func:`_numbers`.
        names: Its accessors.
        matrix: Its transformation, shape (4, 4).
        width: Number of harmonics.
    """
    means, _ = read(names["POSITION"], 3)
    opacity, steps = read(names[f"{_EXTENSION}:OPACITY"], 1)
    scales, others = size_logarithms(read(names[f"{_EXTENSION}:SCALE"], 3)[0], "attribute `SCALE`")
    outside = ~(np.abs(opacity[:, 0] - 0.5) <= 0.501)  # and what is not a number
    others["attribute `OPACITY` is not from 0 to 1 (store the opacity itself, not its logit)"] = outside
    sh = np.zeros((len(means), width, 3), dtype=np.float32)
    for place, name in enumerate(_harmonics(_degree(names))):
        sh[:, place] = read(names[name], 3)[0]
    quats = read(names[f"{_EXTENSION}:ROTATION"], 4)[0][:, [3, 0, 1, 2]]
    opacities = logits(opacity[:, 0], steps)
    cloud = cloud_of(path, others, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not (np.isfinite(matrix).all() and lengths.all()):
        raise ValueError("the transformation of a node is singular or infinite")
    turn = matrix[:3, :3] / lengths
    if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise ValueError(f"{path} shears or mirrors its Gaussians by a node; apply that before the export.")
    moved = _moved(cloud, *map(torch.from_numpy, (matrix[:3, :3].copy(), matrix[:3, 3].copy())))
    return moved if moved is cloud else repaired(path, moved)


def _numbers(root: dict[str, Any], buffers: Any, index: int, width: int) -> tuple[np.ndarray, int]:
    """Numbers of an accessor as float32, shape (count, width), and the number of their steps from 0 to 1."""
    accessor = root["accessors"][index]
    if "sparse" in accessor or accessor["type"] != ("SCALAR" if width == 1 else f"VEC{width}"):
        raise ValueError(f"accessor {index} is sparse or not of {width} numbers")
    dtype, view = np.dtype(_TYPES[accessor["componentType"]]), root["bufferViews"][accessor["bufferView"]]
    first = view.get("byteOffset", 0)
    data = buffers(view["buffer"])[first : first + view["byteLength"]]
    if len(data) == 0:  # for which numpy would make an array of its own
        raise ValueError(f"the buffer of accessor {index} is too short")
    stride = view.get("byteStride", width * dtype.itemsize), dtype.itemsize
    rows: np.ndarray = np.ndarray((accessor["count"], width), dtype, data, accessor.get("byteOffset", 0), stride)
    values = rows.astype(np.float32)
    if not accessor.get("normalized") or dtype.kind == "f":
        return values, _STEPS
    top = int(np.iinfo(dtype).max)
    return np.maximum(values / np.float32(top), -1), top


def _buffer(path: Path, root: dict[str, Any], binary: np.ndarray, index: int) -> np.ndarray:
    uri = root["buffers"][index].get("uri")
    if uri is None:
        return binary
    if uri.startswith("data:"):
        return np.frombuffer(base64.b64decode(uri.partition(",")[2], validate=True), dtype=np.uint8)
    name = unquote(uri)
    if Path(name).name != name or name in ("", ".", ".."):
        raise ValueError(f"{path} takes its data from {name[:80]!r}; put that file beside it.")
    return np.fromfile(check_regular(path.with_name(name), "the buffer"), dtype=np.uint8)


def _harmonics(degree: int) -> list[str]:
    return [f"{_EXTENSION}:SH_DEGREE_{band}_COEF_{k}" for band in range(degree + 1) for k in range(2 * band + 1)]


def _degree(names: dict[str, Any]) -> int:
    return max((band for band in range(4) if any(f":SH_DEGREE_{band}_" in name for name in names)), default=0)


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
