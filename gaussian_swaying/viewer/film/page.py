"""One .html file that plays a film: page, program and data, all inside it."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying._files import write_text
from gaussian_swaying.recording.nodes import join_far, split_at
from gaussian_swaying.viewer.film.recorded import Film, read_film

PAGE = Path(__file__).parent / "page"
SPLATS = ("position", "place", "scale", "turn", "facing", "color")


def write_film(run: Path, target: Path) -> Film:
    """Write the film of a recorded run as one .html file.

    Args:
        run: The output folder of ``gaussian-swaying sim``.
        target: The file; its name ends in .html.

    Returns:
        The film.

    Raises:
        ValueError: If the run cannot become a film (see :func:`~gaussian_swaying.viewer.film.recorded.read_film`), or
            the name of the target does not end in .html.
    """
    if target.suffix.lower() != ".html":
        raise ValueError(f"Expected the name of a film to end in .html, but got {target}.")
    film = read_film(run)
    text = page(film)
    write_text(target, text)
    return film


def page(film: Film) -> str:
    """The whole page of a film."""
    blocks = {"code": (PAGE / "film.min.js").read_bytes(), **pack(film)}
    parts = [
        f'<script type="text/plain" id="film-{name}">{base64.b64encode(zlib.compress(block, 9)).decode()}</script>'
        for name, block in blocks.items()
    ]
    red, green, blue = (round(255 * value) for value in film.head["background"])
    words = {
        "title": html.escape(film.head["title"]),
        "background": f"rgb({red}, {green}, {blue})",
        "licences": (PAGE / "LICENSES.txt").read_text(encoding="utf-8"),
        "parts": "\n".join(parts),
    }
    text = (PAGE / "film.html").read_text(encoding="utf-8")
    return re.sub(r"{{(\w+)}}", lambda slot: words[slot[1]], text)  # once: what is put in may have braces of its own


def pack(film: Film) -> dict[str, bytes]:
    """The blocks of data that the page unpacks.

    Bytes of the same weight stand together, and frames are differences to the frame before as whole numbers; both
    lose nothing, and the blocks compress to less.
    """
    near, far = zip(*(_split(frame) for frame in film.displacement), strict=True)
    bits = np.stack(near).view(np.uint16)
    frames = bits.copy()
    frames[1:] -= bits[:-1]  # modulo 65536
    counts = np.array([len(rows) for rows in far], np.uint32)
    return {
        "head": json.dumps(film.head).encode(),
        **pack_still(film),
        "frames": _planes(frames),
        "far": _planes(counts) + _planes(np.concatenate(far)),
    }


def pack_still(film: Film) -> dict[str, bytes]:
    """The blocks of :func:`pack` that are the same in all frames."""
    return {"splats": b"".join(_planes(getattr(film, name)) for name in SPLATS), "nodes": _planes(film.nodes)}


def _split(displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One frame in float16, and in float32 the nodes that float16 would round."""
    with np.errstate(over="ignore"):
        rounded = displacement.astype(np.float16).astype(np.float32)
    return split_at(displacement, (rounded != displacement).any(axis=1))


def unpack(blocks: dict[str, bytes]) -> Film:
    """The inverse of :func:`pack`."""
    head = json.loads(blocks["head"])
    count, at = head["count"], 0
    found: dict[str, Any] = {}
    kinds = {"position": "<f4", "place": "<f4", "scale": "<f2", "turn": "<i2", "facing": "<i2", "color": "u1"}
    for name in SPLATS:
        kind = np.dtype(kinds[name])
        width = 4 if name in ("turn", "facing", "color") else 3
        size = count * width * kind.itemsize
        found[name] = _unplaned(blocks["splats"][at : at + size], kind).reshape(count, width)
        at += size
    frames = _unplaned(blocks["frames"], np.dtype("<u2")).reshape(head["frames"], head["nodes"], 3)
    bits = np.cumsum(frames, axis=0, dtype=np.uint16)
    nodes = _unplaned(blocks["nodes"], np.dtype("<u4"))
    size = 4 * head["frames"]
    counts = _unplaned(blocks["far"][:size], np.dtype("<u4"))
    far = np.split(_unplaned(blocks["far"][size:], np.dtype("<i4")).reshape(-1, 4), np.cumsum(counts)[:-1])
    moved = [join_far(near, rows) for near, rows in zip(bits.view(np.float16), far, strict=True)]
    return Film(head, **found, nodes=nodes, displacement=np.stack(moved))


def _planes(values: np.ndarray) -> bytes:
    """The lowest bytes of all numbers, then the next ones, and so on."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return little.reshape(-1).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()


def _unplaned(block: bytes, kind: np.dtype) -> np.ndarray:
    planes = np.frombuffer(block, np.uint8).reshape(kind.itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).view(kind)
