"""Malformed splats in the small formats and glTF: bytes at random, and documents with other entries."""

from __future__ import annotations

import gzip
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sandbox import Case

FILES = Path(__file__).parents[1] / "gaussians" / "files"
VALUES = (None, True, -1, 0, 1, 3, 2**31, 2**63, 10**25, 1e308, float("nan"), "", "..", "/etc/hosts", [], {}, [1e30])
Spoil = Callable[[random.Random], bytes]


def _bytes(rng: random.Random, content: bytes) -> bytes:
    """Some bytes changed, cut out or put in, or the end cut off."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 10)) if data else 0):
        at, kind = rng.randrange(len(data)), rng.random()
        if kind < 0.6:
            data[at] = rng.choice((0, 1, 127, 255, rng.randrange(256)))
        elif kind < 0.75:
            del data[max(at, 1) : at + rng.randrange(1, 40)]
        elif kind < 0.9:
            data[at:at] = rng.randbytes(rng.randrange(1, 9))
        else:
            del data[max(at, 1) :]
    return bytes(data)


def _document(rng: random.Random, content: bytes) -> bytes:
    """JSON with some entries replaced."""
    document = json.loads(content)
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            places.append((part, key))
            if isinstance(value, (dict, list)):
                walk(value)

    walk(document)
    for part, key in rng.sample(places, rng.choice((1, 1, 2))):
        part[key] = rng.choice(VALUES)
    return json.dumps(document).encode()


def _read(name: str) -> bytes:
    return (FILES / name).read_bytes()


def _unzipped(rng: random.Random) -> bytes:
    return gzip.compress(_bytes(rng, gzip.decompress(_read("scene_v3.spz"))))


def _glb(rng: random.Random) -> bytes:
    content = _read("scene.glb")
    end = 20 + struct.unpack_from("<I", content, 12)[0]
    text = _document(rng, content[20:end])
    size = 12 + 8 + len(text) + len(content) - end
    return struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text + content[end:]


def _sog(rng: random.Random) -> bytes:
    with zipfile.ZipFile(FILES / "scene.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(["meta.json", "meta.json", *files])
    files[name] = (_document if name == "meta.json" else _bytes)(rng, files[name])
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


CHANGES: dict[str, tuple[str, Spoil]] = {
    "gzip": (".spz", lambda rng: _bytes(rng, _read("scene_v3.spz"))),
    "spz": (".spz", _unzipped),
    "zstandard": (".spz", lambda rng: _bytes(rng, _read("scene_v4.spz"))),
    "glb": (".glb", lambda rng: _bytes(rng, _read("scene.glb"))),
    "gltf": (".glb", _glb),
    "zip": (".sog", lambda rng: _bytes(rng, _read("scene.sog"))),
    "sog": (".sog", _sog),
}


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed; all are exported."""
    for number in range(count):
        rng = random.Random(f"splat {seed} {number}")
        kind = rng.choice([*CHANGES])

        def make(folder: Path, rng: random.Random = rng, kind: str = kind) -> list[str]:
            suffix, spoil = CHANGES[kind]
            path = folder / f"bad{suffix}"
            path.write_bytes(spoil(rng))
            return [str(path), "out.ply"]

        yield Case("splat", f"{number} {kind}", "export", make)
