"""A film as a .sway file, or as one .html file that plays it: page, program and data, all inside it."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import zlib
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying._checks import first_line
from gaussian_swaying._files import atomic, check_page, write_text
from gaussian_swaying.gaussians.ply import check_folder
from gaussian_swaying.player.film.recorded import FIRST, PART, STEPS, Film, read_film

PAGE = Path(__file__).parent / "page"
RECORD = {
    "position": "<f4",
    "color": "u1",
    "turn": "<i2",
    "scale": "<f2",
    "growth": "u1",
    "arm": "<f4",
    "stencil": "<u4",
    "facing": "<i2",
}
"""The numbers that are stored of a Gaussian, in this order; the last three only of those that move."""
KINDS = ("moving", "still")
GROUP = 32
"""Frames of a part."""
MAGIC, VERSION = b"SWAY", 1
ELEMENT = "gaussian-swaying.js"


def write_film(run: Path, target: Path) -> Film:
    """Write the film of a recorded run as one file.

    Args:
        run: The output folder of ``gaussian-swaying sim``.
        target: The file; its name ends in .html for a page, or in .sway for the film alone (docs/bundle.md).
    """
    bundle = target.suffix == ".sway"
    if not bundle:
        check_page(target, "film")
    check_folder(target)
    film = read_film(run)
    if bundle:
        with atomic(target) as temporary:
            temporary.write_bytes(bundled(film))
    else:
        write_text(target, page(film))
    return film


def bundled(film: Film, level: int = 9) -> bytes:
    """The content of a .sway file: a heading, then the blocks, compressed at a level of zlib, each after its size."""
    found = [MAGIC, VERSION.to_bytes(4, "little")]
    for block in pack(film).values():
        packed = zlib.compress(block, level)
        found += [len(packed).to_bytes(4, "little"), packed]
    return b"".join(found)


def read_bundle(path: str | os.PathLike[str]) -> Film:
    """The film in a .sway file.

    Raises:
        ValueError: If it is no such file, of a later version, or damaged.
    """
    content, at, blocks = Path(path).read_bytes(), 8, []
    if content[:4] != MAGIC or len(content) < 8:
        raise ValueError(f"{path} is no .sway file: write one with `gaussian-swaying export RUN film.sway`.")
    version = int.from_bytes(content[4:8], "little")
    if version != VERSION:
        raise ValueError(f"{path} is a .sway file of version {version}, but this program reads {VERSION}: update it.")
    try:
        while at < len(content):
            size = int.from_bytes(content[at : at + 4], "little")
            blocks.append(zlib.decompress(content[at + 4 : at + 4 + size]))
            at += 4 + size
        return unpack(dict(zip(["head", "stencils", *(f"part-{k}" for k in range(len(blocks)))], blocks, strict=False)))
    except (zlib.error, ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path} is damaged ({first_line(error)}): export the run again.") from error


def page(film: Film) -> str:
    """The whole page of a film."""
    return filled("film", film.head, {"code": (PAGE / "film.min.js").read_bytes(), **pack(film)})


def write_player(folder: Path) -> list[Path]:
    """Write the programs that play .sway files elsewhere, and return the files.

    These are ``sway.js`` for scenes of three.js and Spark, ``sway-playcanvas.js`` for those of PlayCanvas, and
    ``gaussian-swaying.js`` with the element
    ``<gaussian-swaying src=...>``, which also shows pages that simulate, and needs ``player.html`` and ``player.js``.
    """
    check_folder(folder / ELEMENT)
    sources = {"sway.js": "sway.min.js", "sway-playcanvas.js": "sway-playcanvas.min.js", "player.js": "film.min.js"}
    sources[ELEMENT] = ELEMENT
    files = {name: (PAGE / source).read_text(encoding="utf-8") for name, source in sources.items()}
    files["player.html"] = filled("file", {"title": "A film", "background": [1.0, 1.0, 1.0]}, {})
    for name, text in files.items():
        write_text(folder / name, text)
    return [folder / name for name in files]


EMBEDDED = "<script>\n{loader}\nloadPage({options});\n</script>"
SERVED = '<script src="player.js"></script>\n<script>{start}</script>'
STARTS = {
    "film": EMBEDDED.replace("{options}", "{ what: 'film', early: ['part-0', 'part-1', 'part-2'], play: 'playFilm' }"),
    "page": EMBEDDED.replace("{options}", "{ what: 'page', early: ['worker', 'part-0'], play: 'swayInWind' }"),
    "live": SERVED.replace("{start}", "watchWind();"),
    "file": SERVED.replace("{start}", "playFile(new URLSearchParams(location.search).get('src'));"),
}
"""How each kind of page starts: a film and a page that simulates have all inside, the live page and one that plays a
.sway file beside it get program and data from a server."""
HINTS = {
    "page": "Turn the arrow for the wind, drag the object to pull it, and the rest to look around.",
    "live": "Connecting …",
}


def filled(kind: str, head: dict[str, Any], blocks: dict[str, bytes]) -> str:
    """An HTML page: the player with its data.

    Args:
        head: The head of a film, of which title and background are put in.
        blocks: What the page unpacks, by name, in the order in which it is needed.
    """
    parts = [
        f'<script type="text/plain" id="film-{name}" data-size="{len(text)}">{text}</script>'
        for name, block in blocks.items()
        for text in [base64.b64encode(zlib.compress(block, 9)).decode()]
    ]
    red, green, blue = (round(255 * value) for value in head["background"])
    words = {
        "title": html.escape(head["title"]),
        "hint": HINTS.get(kind, "Drag to look around, pinch or scroll to come closer."),
        "background": f"rgb({red}, {green}, {blue})",
        "self": "'self'" if kind in ("live", "file") else "",
        "licences": (PAGE / "LICENSES.txt").read_text(encoding="utf-8"),
        "start": STARTS[kind].replace("{loader}", (PAGE / "loader.js").read_text(encoding="utf-8")),
        "parts": "\n".join(parts),
    }
    text = (PAGE / "player.html").read_text(encoding="utf-8")
    return re.sub(r"{{(\w+)}}", lambda slot: words[slot[1]], text)  # once: what is put in may have braces of its own


def message(head: dict[str, Any], *blocks: bytes) -> bytes:
    """A message for a page: length of the head (uint32, little-endian), head in JSON, then the bytes."""
    text = json.dumps(head, allow_nan=False).encode()
    return b"".join([len(text).to_bytes(4, "little"), text, *blocks])


def in_steps(displacement: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Quantise displacements to 16-bit steps; nodes that swing too far are stored apart.

    A node at the border of a body has almost no mass, and may swing by thousands of times its size.

    Args:
        displacement: Displacement of the nodes [m], shape (N, 3).
        step: Length of a step [m].

    Returns:
        The numbers, int16, shape (N, 3), zero for the far nodes; index and displacement of these, the latter as the
        bits of float32, int32, shape (L, 4).
    """
    steps = np.round(displacement / step)
    far = ~(np.abs(steps).max(axis=1, initial=0) < STEPS)
    index = far.nonzero()[0].astype(np.int32)
    rows = np.concatenate([index[:, None], displacement[far].astype(np.float32).view(np.int32)], axis=1)
    return np.where(far[:, None], 0, steps).astype(np.int16), rows


def of_steps(near: np.ndarray, far: np.ndarray, step: float) -> np.ndarray:
    """The inverse of :func:`in_steps`, float32, shape (N, 3)."""
    displacement: np.ndarray = near * np.float32(step)
    displacement[far[:, 0]] = np.ascontiguousarray(far[:, 1:]).view(np.float32)
    return displacement


def parts_of(head: dict[str, Any]) -> list[list[Any]]:
    """The order of the parts of a file: kind, and first and last (excluded) of its Gaussians or frames.

    The first parts, ``head["start"]`` of them, are enough for a first picture: some of all Gaussians, and some frames.
    Then frames, Gaussians that move and others follow in turn, so that the film plays while it is read.
    """

    def cut(kind: str, count: int, first: int, later: int) -> list[list[Any]]:
        ends = [0, *range(first, count, later), count] if count else [0]
        return [[kind, begin, end] for begin, end in pairwise(ends)]

    lists = [
        cut("moving", head["moving"], FIRST["moving"], PART),
        cut("still", head["count"] - head["moving"], FIRST["still"], PART),
        cut("frames", head["frames"], GROUP, GROUP),
    ]
    return [part for turn in zip_longest(*lists) for part in turn if part is not None]


def pack(film: Film) -> dict[str, bytes]:
    """The blocks of data that the page unpacks, in the order in which it needs them.

    Bytes of the same weight stand together, and frames are differences to the frame before, modulo 65536; both lose
    nothing, and the blocks compress to less.
    """
    steps = [in_steps(frame, film.head["step"]) for frame in film.displacement]
    far = [rows for _, rows in steps]
    near = np.array([frame for frame, _ in steps], np.int16).reshape(film.displacement.shape)
    frames: np.ndarray = np.diff(near.view(np.uint16), axis=0, prepend=np.uint16(0))
    counts = np.array([len(rows) for rows in far], np.uint32)
    parts = parts_of(film.head)
    blocks = pack_head(film, parts)
    for index, (kind, first, last) in enumerate(parts):
        if kind == "frames":
            rows = np.concatenate(far[first:last])
            block = planes(folded(frames[first:last])) + planes(counts[first:last]) + planes(rows)
        else:
            block = pack_splats(film, kind == "moving", first, last)
        blocks[f"part-{index}"] = block
    return blocks


def pack_head(film: Film, parts: list[list[Any]]) -> dict[str, bytes]:
    """The first two blocks: the head, with the parts that follow, and the stencils."""
    start = len({kind for kind, _, _ in parts})
    return {
        "head": json.dumps(film.head | {"parts": parts, "start": start}).encode(),
        "stencils": planes(film.stencils),
    }


def pack_splats(film: Film, moving: bool, first: int = 0, last: int | None = None) -> bytes:
    """Moving or static Gaussians of a film, as the page reads them.

    Args:
        last: The last (excluded); all if None.
    """
    count = film.head["moving"]
    base, names = (0, list(RECORD)) if moving else (count, list(RECORD)[:5])
    end = (count if moving else len(film.position)) if last is None else base + last
    if base + first >= end:
        return b""
    columns = [getattr(film, name)[base + first : end].astype(RECORD[name]) for name in names]
    rows = np.concatenate([column.view(np.uint8).reshape(len(column), -1) for column in columns], axis=1)
    return rows.T.tobytes()


def unpack(blocks: dict[str, bytes]) -> Film:
    """The inverse of :func:`pack`, with displacements to half a step; ``order`` is lost."""
    head = json.loads(blocks["head"])
    parts, _ = head.pop("parts"), head.pop("start")
    found: dict[str, list[np.ndarray]] = {name: [] for name in RECORD}
    last, moved = np.zeros((head["nodes"], 3), np.uint16), []
    for index, (kind, begin, end) in enumerate(parts):
        block, count = blocks[f"part-{index}"], end - begin
        if kind == "frames":
            size = 2 * count * 3 * head["nodes"]
            frames = unplaned(block[:size], np.dtype("<u2")).reshape(count, head["nodes"], 3)
            frames = frames >> 1 ^ -(frames & 1)
            bits = np.cumsum(np.concatenate([last[None], frames]), axis=0, dtype=np.uint16)[1:]
            counts = unplaned(block[size : size + 4 * count], np.dtype("<u4"))
            rows = unplaned(block[size + 4 * count :], np.dtype("<i4")).reshape(-1, 4)
            far = np.split(rows, np.cumsum(counts)[:-1])
            moved += [of_steps(*frame, head["step"]) for frame in zip(bits.view(np.int16), far, strict=True)]
            last = bits[-1]
            continue
        rows, at = np.frombuffer(block, np.uint8).reshape(-1, count).T, 0
        for name in list(RECORD)[: 8 if kind == "moving" else 5]:
            own = np.dtype(RECORD[name])
            width = own.itemsize * {"turn": 4, "facing": 4, "color": 4, "growth": 1, "stencil": 1}.get(name, 3)
            found[name].append(np.ascontiguousarray(rows[:, at : at + width]).view(own))
            at += width
    kinds = [kind for kind, _, _ in parts if kind != "frames"]
    fields: dict[str, Any] = {}
    for name, pieces in found.items():
        owners = kinds if len(pieces) == len(kinds) else ["moving"] * len(pieces)
        ordered = [piece for kind in KINDS for piece, owner in zip(pieces, owners, strict=True) if owner == kind]
        fields[name] = np.concatenate(ordered)
    stencils = unplaned(blocks["stencils"], np.dtype("<u4")).reshape(-1, 27)
    return Film(
        head,
        **fields,
        order=np.arange(head["count"]),
        stencils=stencils,
        displacement=np.array(moved, np.float32).reshape(-1, head["nodes"], 3),
    )


def folded(values: np.ndarray) -> np.ndarray:
    """16-bit numbers with the sign moved to the last bit, so that small ones have a zero first byte, uint16."""
    bits = values.view(np.uint16)
    found: np.ndarray = bits << 1 ^ -(bits >> 15)
    return found


def planes(values: np.ndarray) -> bytes:
    """Bytes regrouped by significance: the first bytes of all numbers, then the second bytes, and so on."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return little.reshape(-1).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()


def unplaned(block: bytes, kind: np.dtype) -> np.ndarray:
    """The inverse of :func:`planes`, in one dimension."""
    planes = np.frombuffer(block, np.uint8).reshape(kind.itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).view(kind)
