"""PlayCanvas' SOG, version 2: WebP pictures whose pixels are Gaussians, in a folder or bundled as .sog."""

from __future__ import annotations

import functools
import io
import json
import os
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import one_line
from gaussian_swaying._inputs import LARGEST_HEAD, check_regular, check_unpacked, parse_json, read_json
from gaussian_swaying.gaussians.cloud import GaussianCloud, joined
from gaussian_swaying.gaussians.packed import (
    check_count,
    floats,
    logits,
    smallest_three,
    warn_antialiased,
    with_largest,
)
from gaussian_swaying.gaussians.repair import cloud_of

LARGEST_SIDE = 16383  # pixels of a WebP picture
PALETTE = 1 << 16  # number of different sets of harmonics beyond degree 0; a pixel has 16 bits for it
_ROW = 64  # sets in a row of their picture
_REST = (0, 3, 8, 15)  # harmonics beyond degree 0, by degree
_LARGEST_TAG = 252  # alpha of a quaternion whose largest component is w; x, y and z follow
_MOST_MEANS = 1024  # within one of 256 groups of sets, as time grows with them
_SAMPLE = 1 << 20  # values of which a code book is made


def read_sog(path: str | os.PathLike[str], level: int = 0) -> GaussianCloud:
    """Read SOG: a bundle (.sog), the meta.json of a folder, or the lod-meta.json of a streamed scene.

    Centres have 16 bits on a logarithmic scale; sizes, colours and harmonics are entries of code books of 256 numbers;
    opacities and rotations have 8 bits. Of a streamed scene, one level of detail is read.

    Args:
        level: Level of detail of a streamed scene; 0 is the finest.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals, in the axes of the file.
    """
    path = check_regular(path, "the SOG file")
    meta = read_json(path, "SOG file") if path.suffix.lower() == ".json" else None
    if isinstance(meta, dict) and "lodLevels" in meta:
        return _streamed(path, meta, level)
    return _single(path)


def encode_sog(cloud: GaussianCloud) -> bytes:
    """A bundle (.sog). The Gaussians are sorted along a space-filling curve, which makes the file smaller.

    Up to 65,536 different sets of harmonics beyond degree 0 are kept; where there are more, similar ones are averaged.
    """
    count = len(cloud)
    width = -(-int(np.ceil(np.sqrt(count))) // 4) * 4
    if width > LARGEST_SIDE:
        raise ValueError(f"A .sog file holds up to {LARGEST_SIDE**2:,} Gaussians, but there are {count:,}: choose spz.")
    means = floats(cloud.means).astype(np.float64)
    order = _curve(means)
    means, quats, scales, opacities, sh = (
        part[order] for part in (means, *map(floats, (cloud.quats, cloud.scales, cloud.opacities, cloud.sh)))
    )
    pictures: dict[str, bytes] = {}

    def store(name: str, *channels: np.ndarray, columns: int = width) -> None:
        """A picture of channels (N,) or (N, C), in rows of so many pixels; unused channels are opaque."""
        values = np.concatenate([c.reshape(len(c), -1) for c in channels], axis=1)
        pixels = np.full((-(-len(values) // columns) * columns, 4), 255, dtype=np.uint8)
        pixels[: len(values), : values.shape[1]] = values
        pictures[name] = _webp(pixels.reshape(-1, columns, 4))

    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    whole = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    store("means_l.webp", whole & 255)
    store("means_u.webp", whole >> 8)
    small, place = smallest_three(quats)
    store("quats.webp", np.rint((small / np.sqrt(2) + 0.5) * 255), place + _LARGEST_TAG)
    size_book, sizes = _coded(scales)
    store("scales.webp", sizes)
    color_book, colors = _coded(sh[:, 0])
    store("sh0.webp", colors, np.rint(255 / (1 + np.exp(-opacities))))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "gaussian_swaying"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": size_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    if cloud.sh_degree:
        palette, labels = _palette(sh[:, 1:].reshape(count, -1))
        rest_book, entries = _coded(palette)
        rows = np.zeros((-(-len(palette) // _ROW) * _ROW, _REST[cloud.sh_degree], 3), dtype=np.uint8)
        rows[: len(palette)] = entries.reshape(len(palette), -1, 3)
        store("shN_centroids.webp", rows.reshape(-1, 3), columns=_ROW * rows.shape[1])
        store("shN_labels.webp", labels & 255, labels >> 8, np.zeros(count))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(palette), "bands": cloud.sh_degree, "codebook": rest_book, "files": files}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:  # the time of every entry is that of 1980
        for name, picture in {**pictures, "meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(zipfile.ZipInfo(name), picture)
    return content.getvalue()


# ---- files and folders

_Read = Callable[[str], bytes]
"""Gives the content of a file by its name in meta.json."""


def _single(path: Path) -> GaussianCloud:
    if path.suffix.lower() == ".json":
        meta = read_json(path, "SOG file")
        return _decoded(path, meta, lambda name: check_regular(_inside(path, name), "the picture").read_bytes())
    with _archive(path) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        for entry in archive.infolist():
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise NotImplementedError(f"`{entry.filename[:40]}` is compressed by other means than deflate")
    check_unpacked(path, sum(sizes.values()), f"{len(sizes)} files")

    used = set()

    def read(name: str) -> bytes:
        if name not in sizes:
            raise _broken(path, f"it has no file `{name[:40]}`")
        used.add(name)
        with _archive(path) as archive:
            return archive.read(name)

    if sizes.get("meta.json", 0) > LARGEST_HEAD:
        raise _broken(path, "its meta.json is too large")
    cloud = _decoded(path, parse_json(read("meta.json"), "SOG file", path), read)
    if len(used) < len(sizes):
        ignored = ", ".join(sorted(set(sizes) - used))[:200]
        warnings.warn(f"{path}: ignored the files {ignored}, which its meta.json does not name.", stacklevel=3)
    return cloud


@contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as stream:
            begins = stream.read(4)
            stream.seek(-22 - len(archive.comment), os.SEEK_END)
            if begins != b"PK\3\4" or stream.read(4) != b"PK\5\6":
                raise zipfile.BadZipFile("bytes precede or follow it that do not belong to it")
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise _broken(path, one_line(error)) from error


def _inside(path: Path, name: Any) -> Path:
    steps = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not steps or ".." in steps or name.startswith("/") or "\\" in name or ":" in name:
        raise ValueError(f"{path} names the file {str(name)[:80]!r}; put all files into its folder.")
    return path.parent.joinpath(*steps)


def _streamed(path: Path, meta: dict[str, Any], level: int) -> GaussianCloud:
    levels, names = meta["lodLevels"], meta.get("filenames")
    if type(levels) is not int or not isinstance(names, list):
        raise _broken(path, "`lodLevels` or `filenames` is not as it should be")
    if not 0 <= level < levels:
        raise ValueError(f"{path} has the levels 0 to {levels - 1}, but level {level} was asked for.")
    if meta.get("environment"):
        warnings.warn(f"{path}: left out its environment, {meta['environment']!r}.", UserWarning, stacklevel=3)
    ranges: dict[Path, list[tuple[int, int]]] = {}
    nodes = [meta.get("tree")]
    while nodes:
        node = nodes.pop()
        lods, children = (node.get("lods", {}), node.get("children", [])) if isinstance(node, dict) else (None, None)
        if not isinstance(lods, dict) or not isinstance(children, list):
            raise _broken(path, "a part of its `tree` is not as it should be")
        nodes += children
        if str(level) in lods:
            wanted = lods[str(level)]
            numbers = [wanted.get(key) for key in ("file", "offset", "count")] if isinstance(wanted, dict) else []
            whole = [number for number in numbers if type(number) is int and number >= 0]
            if len(whole) < 3 or whole[0] >= len(names):
                raise _broken(path, f"a part of its `tree` has no range of Gaussians at level {level}")
            ranges.setdefault(_inside(path, names[whole[0]]), []).append((whole[1], whole[2]))
    parts = []
    for file, wanted in sorted(ranges.items()):
        cloud = _single(check_regular(file, "the SOG file"))
        if sum(count for _, count in wanted) > len(cloud):
            raise _broken(path, f"its `tree` wants more Gaussians than {file} holds")
        for first, count in sorted(wanted):
            if first + count > len(cloud):
                raise _broken(path, f"its `tree` wants Gaussian {first + count - 1} of the {len(cloud)} in {file}")
            parts.append(cloud if count == len(cloud) else cloud.select(torch.arange(first, first + count)))
    if not sum(map(len, parts)):
        raise ValueError(f"{path} holds zero Gaussians at level {level}; export the scene again.")
    return joined(*parts)


def _broken(path: Path, what: str) -> ValueError:
    return ValueError(f"{path} is not a usable SOG file ({what}); export it again.")


# ---- Gaussians from pictures


def _decoded(path: Path, meta: Any, read: _Read) -> GaussianCloud:
    if not isinstance(meta, dict) or meta.get("version", 1) != 2:
        version = meta.get("version", 1) if isinstance(meta, dict) else "unknown"
        raise ValueError(f"{path} is SOG of version {str(version)[:20]}, not 2; convert it with splat-transform.")
    count = meta.get("count")
    if type(count) is not int or count < 1:
        raise _broken(path, f"`count` is {str(count)[:20]}")
    if meta.get("model") == "antialiased":
        warn_antialiased(path)
    read = functools.cache(read)
    part = {name: _part(path, meta, name) for name in ("means", "scales", "quats", "sh0")}
    rest = _part(path, meta, "shN") if "shN" in meta else {}
    bands, sets = rest.get("bands", 0), rest.get("count", 0)
    if rest and (type(bands) is not int or not 1 <= bands <= 3 or type(sets) is not int or not 1 <= sets <= PALETTE):
        raise _broken(path, f"`shN` has {str(sets)[:20]} sets of {str(bands)[:20]} bands")
    size = sum(len(read(name)) for entry in (*part.values(), rest) for name in entry.get("files", []))
    check_count(path, count, 1 + _REST[bands], size)

    def pixels(name: str, number: int = 0) -> np.ndarray:
        """The first pixels of a picture, one for each Gaussian, shape (count, 4)."""
        return _picture(path, read, part[name]["files"], number, count).reshape(-1, 4)[:count]

    low, high = (_numbers(path, part["means"], end, 3, 3) for end in ("mins", "maxs"))
    logs = low + (high - low) * (pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]) / 65535
    packed = _picture(path, read, part["quats"]["files"], 0, count).reshape(-1, 4)
    small = (packed[:, :3] / 255 - 0.5) * np.sqrt(2)
    good = (packed[:, 3] >= _LARGEST_TAG) & (np.square(small).sum(1) < 1)  # 3/4 at the most
    if not good[:count].all():
        raise _broken(path, f"`count` is {count:,}, but a pixel of `quats` among these is no rotation")
    more = int((good[count:] & (packed[count:] != packed[count - 1]).any(1)).sum())
    if more:
        raise _broken(path, f"`count` is {count:,}, but its pictures hold {more:,} Gaussians more")
    colors = pixels("sh0")
    sh = _looked_up(path, part["sh0"], "sh0", colors[:, :3])[:, None, :]
    if bands:
        part["shN"] = rest
        labels = pixels("shN", 1)
        which = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
        if int(which.max()) >= sets:
            raise _broken(path, f"a pixel of `shN` wants set {int(which.max())} of {sets}")
        palette = _picture(path, read, rest["files"], 0, sets * _REST[bands], _ROW * _REST[bands])
        entries = palette.reshape(-1, _REST[bands], 4)[which, :, :3]
        sh = np.concatenate([sh, _looked_up(path, rest, "shN", entries)], axis=1)
    with np.errstate(over="ignore"):
        means = np.sign(logs) * np.expm1(np.abs(logs))
    return cloud_of(
        path,
        means=means,
        quats=with_largest(small[:count], packed[:count, 3] - _LARGEST_TAG),
        scales=_looked_up(path, part["scales"], "scales", pixels("scales")[:, :3]),
        opacities=logits(colors[:, 3] / 255, 255),
        sh=sh,
    )


def _part(path: Path, meta: dict[str, Any], name: str) -> dict[str, Any]:
    entry, needed = meta.get(name), 2 if name in ("means", "shN") else 1
    files = entry.get("files") if isinstance(entry, dict) else None
    good = isinstance(files, list) and len(files) == needed and all(isinstance(file, str) for file in files)
    if not isinstance(entry, dict) or not good:
        raise _broken(path, f"`{name}` does not name {needed} files")
    return entry


def _numbers(path: Path, entry: dict[str, Any], name: str, least: int, most: int) -> np.ndarray:
    values = entry.get(name)
    if isinstance(values, list) and least <= len(values) <= most and all(type(v) in (int, float) for v in values):
        return np.array(values, dtype=np.float64)
    raise _broken(path, f"`{name}` is not a list of {least} to {most} numbers")


def _looked_up(path: Path, entry: dict[str, Any], name: str, which: np.ndarray) -> np.ndarray:
    book = _numbers(path, entry, "codebook", 1, 256)
    if int(which.max()) >= len(book):
        raise _broken(path, f"a pixel of `{name}` wants number {int(which.max())} of a code book of {len(book)}")
    found: np.ndarray = book.astype(np.float32)[which]
    return found


def _picture(path: Path, read: _Read, files: Sequence[str], number: int, least: int, width: int = 0) -> np.ndarray:
    """A picture with at least so many pixels and not far more, shape (height, width, 4)."""
    from PIL import Image

    name = files[number]
    try:
        with Image.open(io.BytesIO(read(name)), formats=["WEBP"]) as picture:
            columns, rows = picture.size
            if columns * rows < least or columns * rows > 2 * least + (1 << 17) or (width and columns != width):
                raise _broken(path, f"`{name[:40]}` has {columns} x {rows} pixels, but `count` asks for {least:,}")
            return np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise _broken(path, f"`{name[:40]}` is not a WebP picture") from error


# ---- pictures from Gaussians


def _webp(pixels: np.ndarray) -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "WEBP", lossless=True, exact=True)
    return content.getvalue()


def _curve(means: np.ndarray) -> np.ndarray:
    """Order of points along a Z-curve of 21 bits for each axis, shape (N,)."""
    low, high = means.min(0), means.max(0)
    cells = ((means - low) / np.where(high > low, high - low, 1) * 0x1FFFFF).astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):  # two zeros between any two bits
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    places = cells[:, 0] | cells[:, 1] << np.uint64(1) | cells[:, 2] << np.uint64(2)
    order: np.ndarray = np.argsort(places, kind="stable")
    return order


def _coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """A code book of up to 256 numbers, and the nearest of them for each value, in the shape of the values."""
    flat = values.ravel()
    sample = np.sort(flat[:: -(-flat.size // _SAMPLE)])
    book = np.unique(sample)
    if book.size > 256 or sample.size < flat.size:
        share = np.linspace(0, 1, 256)
        even = flat.min() + share * (flat.max() - flat.min())
        book = np.sort(0.5 * (np.quantile(sample, share) + even))  # fine where values are, and none is far away
        for _ in range(10):  # Lloyd's iterations
            near = np.searchsorted((book[1:] + book[:-1]) / 2, sample)
            hits = np.bincount(near, minlength=256)
            book = np.where(hits > 0, np.bincount(near, sample, minlength=256) / np.maximum(hits, 1), book)
            book[[0, -1]] = even[[0, -1]]  # what lies beyond the sample stays in range
    book = book.astype(np.float32).astype(np.float64)
    near = np.searchsorted((book[1:] + book[:-1]) / 2, flat)
    return book.tolist(), near.astype(np.uint8).reshape(values.shape)


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Up to 65,536 rows for N rows (N, D), and the one that stands for each, shape (N,).

    If there are more, they are clustered in two steps, each with a number of means near the root of that.
    """
    if len(rows) <= PALETTE:
        return rows, np.arange(len(rows))
    values = torch.from_numpy(rows).float()
    _, coarse = _means(values, 256)
    palette, labels, used = [], torch.empty(len(rows), dtype=torch.int64), 0
    for group in range(256):
        (members,) = torch.nonzero(coarse == group, as_tuple=True)
        if len(members):
            share = len(members) * (PALETTE - 256) // len(rows)
            centres, near = _means(values[members], min(max(share, 1), _MOST_MEANS))
            labels[members] = near + used
            palette.append(centres)
            used += len(centres)
    return torch.cat(palette).double().numpy(), labels.numpy()


def _means(rows: Tensor, count: int, iterations: int = 8) -> tuple[Tensor, Tensor]:
    """The means of clusters (Lloyd) and the nearest for each row; they begin at rows that are evenly spaced."""
    centres = rows[torch.linspace(0, len(rows) - 1, count).long()]
    for _ in range(iterations):
        half = 0.5 * centres.square().sum(1)
        near = torch.cat([(part @ centres.T - half).argmax(1) for part in rows.split(1 << 14)])
        hits = torch.bincount(near, minlength=count)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, near, rows)
        centres = torch.where(hits > 0, sums / hits.clamp(min=1), centres)
    return centres, near
