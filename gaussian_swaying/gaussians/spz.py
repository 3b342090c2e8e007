"""Niantic's SPZ: 17 to 65 bytes for each Gaussian, compressed by gzip (versions 1 to 3) or Zstandard (version 4)."""

from __future__ import annotations

import gzip
import os
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.packed import (
    check_count,
    floats,
    logits,
    smallest_three,
    usable,
    warn_antialiased,
    with_largest,
)
from gaussian_swaying.gaussians.repair import cloud_of

WRITTEN = (2, 3, 4)
_MAGIC = b"NGSP"
_HEAD = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, streams
_TABLE = 32  # offset of the table of streams in a file of version 4 without extensions
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_AXES = 0xADBE0003  # the extension SPZ_ADOBE_coordinate_system
COLOR_SCALE = 0.15  # wider than that of the harmonics, as colours may be beyond 0 and 1
_LARGEST_EXTENSIONS = 1 << 24  # bytes
_BITS = (5, 4)  # of harmonics of band 1 and above, as Niantic's writer keeps by default


def read_spz(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read an .spz file of version 1 to 4.

    Sizes, opacities, colours and harmonics have 8 bits; centres are whole multiples of a power of two (half precision
    in version 1). An opacity at the end of its range is moved inwards by half a step. The axes are those of the file:
    y is up by Niantic's convention, but many converters leave the axes of a .ply. Harmonics of degree 4 are left out.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals.
    """
    path = check_regular(path, "the .spz file")
    with usable(path, ".spz file"):
        (_, version, count, degree, fraction, flags, _), parts, extensions = _opened(path)
        _check_axes(path, extensions)
        if flags & _ANTIALIASED:
            warn_antialiased(path)
        if degree == 4:
            told = f"{path}: ignored the harmonics of degree 4; those up to 3 are used."
            warnings.warn(told, UserWarning, stacklevel=2)
        positions, alphas, colors, scales, rotations, rest = parts
        sh = np.empty((count, (min(degree, 3) + 1) ** 2, 3), dtype=np.float32)
        sh[:, 0] = ((colors / 255 - 0.5) / COLOR_SCALE).reshape(count, 3)
        sh[:, 1:] = rest.reshape(count, -1, 3)[:, :15]
        sh[:, 1:] = (sh[:, 1:] - 128) / 128
        return cloud_of(
            path,
            means=positions.view("<f2").reshape(-1, 3) if version == 1 else _fixed(positions, fraction),
            quats=_from_three(rotations) if version < 3 else _from_smallest(rotations),
            scales=scales.reshape(count, 3) / 16 - 10,
            opacities=logits(alphas / 255, 255),
            sh=sh,
        )


def encode_spz(cloud: GaussianCloud, spz_version: int = 3) -> bytes:
    """An .spz file.

    Centres have 24 bits, as many of them behind the binary point as the largest coordinate allows, up to 24. Sizes lie
    between 4.5e-5 and 380 scene units, in steps of 6 %. Harmonics have 5 bits in band 1 and 4 above.

    Args:
        spz_version: 3 is read by most programs; 4 needs zstandard; 2 has coarser rotations.

    Returns:
        The content of the file.
    """
    if spz_version not in WRITTEN:
        raise ValueError(f"Expected `spz_version` to be 2, 3 or 4, but got {spz_version}.")
    compress = _zstandard().ZstdCompressor(level=12).compress if spz_version == 4 else None
    means, quats, scales, opacities, sh = (
        floats(part) for part in (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    )
    farthest = float(np.abs(means).max(initial=0.0))
    if farthest >= 2**23 - 1:
        raise ValueError(
            f"An .spz file holds centres up to ±8e6, but one is at {farthest:g}: remove what is far away, or choose "
            "another format."
        )
    fraction = fraction_bits(farthest)
    parts = (
        _int24(means * np.float64(2.0**fraction)),
        _byte(255 / (1 + np.exp(-opacities))),
        _byte(sh[:, 0] * COLOR_SCALE * 255 + 127.5),
        _byte((scales + 10) * 16),
        _to_three(quats) if spz_version < 3 else _to_smallest(quats),
        np.concatenate([_coarse(sh[:, 1:4], _BITS[0]), _coarse(sh[:, 4:], _BITS[1])], axis=1),
    )
    packed = [part.tobytes() for part in parts if part.size]
    streams = len(packed) if spz_version == 4 else 0
    head = _HEAD.pack(_MAGIC, spz_version, len(cloud), cloud.sh_degree, fraction, 0, streams)
    if compress is None:
        return gzip.compress(head + b"".join(packed), compresslevel=6, mtime=0)
    small = [compress(part) for part in packed]
    table = b"".join(struct.pack("<QQ", len(out), len(part)) for out, part in zip(small, packed, strict=True))
    return head + struct.pack("<I12x", _TABLE) + table + b"".join(small)


def fraction_bits(farthest: float) -> int:
    """Fractional bits of a centre's fixed-point number, given the largest coordinate."""
    return 24 if farthest == 0 else min(24, int(np.floor(np.log2((2**23 - 1) / farthest))))


# ---- the container


def _opened(path: Path) -> tuple[tuple[Any, ...], list[np.ndarray], bytes]:
    with path.open("rb") as raw:
        start = raw.read(4)
    if start[:2] == b"\x1f\x8b":
        with gzip.open(path) as stream:
            head, sizes = _sizes(path, stream.read(_HEAD.size))
            body, extensions = stream.read(sum(sizes)), stream.read(_LARGEST_EXTENSIONS) if head[5] & _EXTENDED else b""
            if head[1] == 4:
                raise ValueError("`version` 4 is not compressed by gzip")
            if len(body) < sum(sizes) or stream.read(1):  # at the end this compares the checksum
                raise _other_size(head, sum(sizes), f"{len(body):,} bytes and maybe more follow")
        return head, np.split(np.frombuffer(body, dtype=np.uint8), np.cumsum(sizes)[:-1]), extensions
    if start != _MAGIC:
        raise ValueError(f"{path} is not an .spz file (it starts neither as gzip nor with `NGSP`); export it again.")
    data = path.read_bytes()
    head, sizes = _sizes(path, data)
    zstandard = _zstandard(path)
    if head[1] != 4:
        raise ValueError("`version` 1 to 3 is compressed by gzip")
    (table,) = struct.unpack_from("<I", data, _HEAD.size)
    place, parts = table + 16 * sum(map(bool, sizes)), []
    for index, size in enumerate(filter(None, sizes)):
        length, _ = struct.unpack_from("<QQ", data, table + 16 * index)
        packed = data[place : place + length]
        place += length
        announced = zstandard.frame_content_size(packed)
        if announced not in (-1, size):
            raise _other_size(head, size, f"stream {index} has {announced:,}")
        part = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size, allow_extra_data=False)
        parts.append(np.frombuffer(part, dtype=np.uint8))
    if place != len(data) or table < _TABLE:
        raise _other_size(head, place, f"there are {len(data):,}")
    return head, [*parts, *([np.empty(0, dtype=np.uint8)] * (len(sizes) - len(parts)))], data[_TABLE:table]


def _sizes(path: Path, data: bytes) -> tuple[tuple[Any, ...], list[int]]:
    """The header, checked, and the size of each part [bytes]."""
    head = _HEAD.unpack_from(data)
    magic, version, count, degree, fraction = head[:5]
    if magic != _MAGIC or not 1 <= version <= 4 or degree > 4 or fraction > 24:
        raise ValueError(f"`version` {version}, harmonics of degree {degree}, `fractional_bits` {fraction}")
    if count == 0:
        raise ValueError(f"{path} holds zero Gaussians; export the scene again.")
    check_count(path, count, (degree + 1) ** 2)
    rows = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
    return head, [count * row for row in rows]


def _other_size(head: tuple[Any, ...], needed: int, found: str) -> ValueError:
    what = "`version` {}, `count` {:,}, `degree` {}".format(*head[1:4])
    return ValueError(f"its header announces {needed:,} bytes ({what}), but {found}")


def _check_axes(path: Path, extensions: bytes) -> None:
    """Raise ValueError if the axes are left-handed, which would mirror the scene."""
    while extensions:
        kind, length = struct.unpack_from("<II", extensions)
        axes = int.from_bytes(extensions[8:12], "little")
        if kind == _AXES and 0 < axes <= 16 and ((axes - 1 & 7) ^ 3).bit_count() % 2:  # 4 stands for right, up, back
            raise ValueError(f"{path} has left-handed axes (number {axes}); export it with others, such as RUB.")
        extensions = extensions[8 + length :]


def _zstandard(path: Path | None = None) -> Any:
    try:
        import zstandard
    except ImportError as error:
        what = "SPZ of version 4 needs" if path is None else f"{path} is of version 4 of SPZ and needs"
        raise ImportError(
            f"{what} zstandard: run pip install 'gaussian-swaying[spz]', or choose version 3.", name="zstandard"
        ) from error
    return zstandard


# ---- numbers


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _coarse(values: np.ndarray, bits: int) -> np.ndarray:
    """Harmonics (N, K, 3) from -1 to 1 as bytes that are multiples of 2^(8 - bits), with 0 at 128."""
    step = 1 << (8 - bits)
    return np.clip(np.floor((np.rint(values * 128) + 128 + step // 2) / step) * step, 0, 255).astype(np.uint8)


def _fixed(raw: np.ndarray, fraction: int) -> np.ndarray:
    """Signed whole numbers of 24 bits, as multiples of 2^-fraction, shape (N, 3)."""
    wide = np.zeros((len(raw) // 3, 4), dtype=np.uint8)
    wide[:, 1:] = raw.reshape(-1, 3)
    values: np.ndarray = (wide.view("<i4").reshape(-1, 3) >> 8) * 2.0**-fraction
    return values


def _int24(values: np.ndarray) -> np.ndarray:
    whole = np.rint(values).astype("<i4")
    return np.ascontiguousarray(whole).view(np.uint8).reshape(-1, 4)[:, :3]


def _from_three(raw: np.ndarray) -> np.ndarray:
    xyz = raw.reshape(-1, 3) / 127.5 - 1
    return np.concatenate([np.sqrt(np.clip(1 - np.square(xyz).sum(-1, keepdims=True), 0, None)), xyz], axis=1)


def _to_three(quats: np.ndarray) -> np.ndarray:
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return _byte(unit[:, 1:] * np.where(unit[:, :1] < 0, -127.5, 127.5) + 127.5)


def _from_smallest(raw: np.ndarray) -> np.ndarray:
    """Quaternions wxyz: 2 bits for the place of the largest component of xyzw; a sign and 9 bits for each other."""
    packed = raw.view("<u4")
    fields = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], -1)
    small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511 * np.sqrt(2))
    return with_largest(small, packed >> 30)[:, [3, 0, 1, 2]]


def _to_smallest(quats: np.ndarray) -> np.ndarray:
    small, place = smallest_three(quats[:, [1, 2, 3, 0]])
    fields = np.rint(np.abs(small) * 511 * np.sqrt(2)).astype(np.uint32) | np.where(small < 0, 512, 0).astype(np.uint32)
    packed = place.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.astype("<u4")
