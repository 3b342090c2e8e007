"""PlayCanvas' SOG, version 2: WebP pictures whose pixels are Gaussians, in a folder or bundled as .sog."""

from __future__ import annotations

import functools
import io
import json
import os
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from gaussian_swaying._inputs import check_regular, check_unpacked, parse_json, read_json
from gaussian_swaying.gaussians.cloud import GaussianCloud, joined
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
    opacities and rotations have 8 bits.

    Args:
        level: Level of detail of a streamed scene that is read; 0 is the finest.

    Returns:
        The Gaussians as float32 tensors on the CPU, without normals, in the axes of the file.
    """
    path = check_regular(path, "the SOG file")
    with usable(path, "SOG file"):
        if path.suffix.lower() == ".json":
            meta = read_json(path, "SOG file")
            if "lodLevels" in meta:
                return _streamed(path, meta, level)
            return _decoded(path, meta, lambda name: check_regular(_beside(path, name), "the picture").read_bytes())
        with zipfile.ZipFile(path) as archive:
            held = archive.infolist()
            if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in held):
                raise ValueError("it is compressed by other means than deflate")  # which may ask for any memory
            check_unpacked(path, sum(entry.file_size for entry in held), f"{len(held)} files")
            return _decoded(path, parse_json(archive.read("meta.json"), "SOG file", path), archive.read)


def encode_sog(cloud: GaussianCloud) -> bytes:
    """A bundle (.sog). The Gaussians are sorted along a space-filling curve, which makes the file smaller.

    Up to 65,536 different sets of harmonics beyond degree 0 are kept; where there are more, similar ones are averaged.

    Returns:
        The content of the file.
    """
    from gsplat.exporter import sort_centers

    count = len(cloud)
    width = -(-int(np.ceil(np.sqrt(count))) // 4) * 4
    if width > LARGEST_SIDE:
        raise ValueError(f"A .sog file holds up to {LARGEST_SIDE**2:,} Gaussians, but there are {count:,}: choose spz.")
    means = floats(cloud.means).astype(np.float64)
    order = sort_centers(torch.from_numpy(means), torch.arange(count)).numpy()
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


# ---- Gaussians from pictures


def _beside(path: Path, name: str) -> Path:
    steps = PurePosixPath(name).parts
    if not steps or ".." in steps or name.startswith("/") or "\\" in name or ":" in name:
        raise ValueError(f"{path} names the file {name[:80]!r}; put all files into its folder.")
    return path.parent.joinpath(*steps)


def _streamed(path: Path, meta: dict[str, Any], level: int) -> GaussianCloud:
    if not 0 <= level < meta["lodLevels"]:
        raise ValueError(f"{path} has the levels 0 to {meta['lodLevels'] - 1}, but level {level} was asked for.")
    if meta.get("environment"):
        warnings.warn(f"{path}: left out its environment, {meta['environment']!r}.", UserWarning, stacklevel=4)
    ranges: dict[Path, list[tuple[int, int]]] = {}
    nodes, parts = [meta["tree"]], list[GaussianCloud]()
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        if str(level) in node.get("lods", {}):
            wanted = node["lods"][str(level)]
            file = _beside(path, meta["filenames"][wanted["file"]])
            ranges.setdefault(file, []).append((wanted["offset"], wanted["count"]))
    for file, places in sorted(ranges.items()):
        if file.name == path.name:
            raise ValueError(f"it names {file.name} as a part of itself")
        cloud, last = read_sog(file), 0
        for first, count in sorted(places):
            if first < last or count < 0 or first + count > len(cloud):
                raise ValueError(
                    f"its `tree` wants Gaussians {first} to {first + count - 1} of {len(cloud)} in {file.name}"
                )
            parts.append(cloud if count == len(cloud) else cloud.select(torch.arange(first, first + count)))
            last = first + count
    if not sum(map(len, parts)):
        raise ValueError(f"{path} holds zero Gaussians at level {level}; export the scene again.")
    return joined(*parts)


def _decoded(path: Path, meta: dict[str, Any], read: Callable[[str], bytes]) -> GaussianCloud:
    if meta.get("version") != 2:
        raise ValueError(f"{path} is not SOG of version 2; convert it with splat-transform.")
    count, read = meta["count"], functools.cache(read)
    if type(count) is not int or count < 1:
        raise ValueError(f"`count` is {str(count)[:20]}")
    if meta.get("model") == "antialiased":
        warn_antialiased(path)
    parts: dict[str, Any] = {name: meta[name] for name in ("means", "scales", "quats", "sh0", "shN") if name in meta}
    more = _REST[parts["shN"]["bands"]] if "shN" in parts else 0
    check_count(path, count, 1 + more, sum(len(read(name)) for part in parts.values() for name in part["files"]))

    def pixels(name: str, number: int = 0, least: int = count, width: int = 0) -> np.ndarray:
        """The pixels of a picture with at least so many and not far more, shape (P, 4)."""
        from PIL import Image

        file = parts[name]["files"][number]
        with Image.open(io.BytesIO(read(file)), formats=["WEBP"]) as picture:
            columns, rows = picture.size
            if columns * rows < least or columns * rows > 2 * least + (1 << 17) or (width and columns != width):
                raise ValueError(f"`{file[:40]}` has {columns} x {rows} pixels, but `count` asks for {least:,}")
            return np.asarray(picture.convert("RGBA")).reshape(-1, 4)

    def looked_up(name: str, which: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.array(parts[name]["codebook"], dtype=np.float64).astype(np.float32)[which]
        return found

    low, high = (np.array(parts["means"][end], dtype=np.float64) for end in ("mins", "maxs"))
    logs = low + (high - low) * (pixels("means")[:count, :3] + 256.0 * pixels("means", 1)[:count, :3]) / 65535
    packed = pixels("quats")[:count]
    small = (packed[:, :3] / 255 - 0.5) * np.sqrt(2)
    if not ((packed[:, 3] >= _LARGEST_TAG) & (np.square(small).sum(1) < 1)).all():  # 3/4 at the most
        raise ValueError(f"`count` is {count:,}, but a pixel of `quats` among these is no rotation")
    colors = pixels("sh0")[:count]
    sh = looked_up("sh0", colors[:, :3])[:, None]
    if more:
        labels, palette = (
            pixels("shN", 1)[:count].astype(np.int64),
            pixels("shN", 0, parts["shN"]["count"] * more, _ROW * more),
        )
        entries = palette.reshape(-1, more, 4)[labels[:, 0] + 256 * labels[:, 1], :, :3]
        sh = np.concatenate([sh, looked_up("shN", entries)], axis=1)
    with np.errstate(over="ignore"):
        means = np.sign(logs) * np.expm1(np.abs(logs))
    return cloud_of(
        path,
        means=means,
        quats=with_largest(small, packed[:, 3] - _LARGEST_TAG),
        scales=looked_up("scales", pixels("scales")[:count, :3]),
        opacities=logits(colors[:, 3] / 255, 255),
        sh=sh,
    )


# ---- pictures from Gaussians


def _webp(pixels: np.ndarray) -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "WEBP", lossless=True, exact=True)
    return content.getvalue()


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
    _, coarse = _means(rows, 256)
    palette, labels, used = [], np.empty(len(rows), dtype=np.int64), 0
    for group in range(256):
        (members,) = np.nonzero(coarse == group)
        if len(members):
            share = len(members) * (PALETTE - 256) // len(rows)
            centres, near = _means(rows[members], min(max(share, 1), _MOST_MEANS))
            labels[members] = near + used
            palette.append(centres)
            used += len(centres)
    return np.concatenate(palette), labels


def _means(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy.cluster.vq import kmeans2

    first = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of means that are nearest to no row
        centres, near = kmeans2(rows, first, 8, minit="matrix")
    return centres, near
