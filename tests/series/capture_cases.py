"""Malformed captures: camera files, sparse models, pictures and points."""

from __future__ import annotations

import json
import os
import random
import runpy
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sandbox import Case

VALUES = (
    None, True, "", "x", -1, 0, 1e30, 1e308, float("nan"), float("inf"), int("9" * 400), 10**30, [], {}, [[0] * 4] * 4,
    [[1e30] * 4] * 4, "../../../etc/passwd", "\u0000", "/dev/zero", [1, 2, 3],
)  # fmt: skip
Change = Callable[[random.Random, Path], None]
ROOT = Path(__file__).parents[2]
TOOLS = SimpleNamespace(**runpy.run_path(str(ROOT / "tests/captures/conftest.py")))


def _json(folder: Path) -> Any:
    return json.loads((folder / "transforms.json").read_text())


def _places(node: Any) -> list[tuple[Any, Any]]:
    keys = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
    return [(node, key) for key in keys] + [place for key in keys for place in _places(node[key])]


def _field(rng: random.Random, folder: Path) -> None:
    tree = _json(folder)
    places = _places(tree)
    node, key = rng.choice(places if rng.random() < 0.5 else [p for p in places if isinstance(p[0], dict)])
    node[key] = rng.choice(VALUES)
    if rng.random() < 0.3:
        tree[rng.choice(("w", "h", "k1", "fl_y", "camera_model", "ply_file_path", "test_filenames"))] = rng.choice(
            VALUES
        )
    (folder / "transforms.json").write_text(json.dumps(tree))


def _text(rng: random.Random, folder: Path) -> None:
    whole = (folder / "transforms.json").read_bytes()
    data = bytearray(whole)
    for _ in range(rng.choice((1, 5))):
        data[rng.randrange(len(data))] = rng.randrange(256)
    depth = rng.choice((1000, 500_000))
    texts = (bytes(data), whole[: rng.randrange(len(whole))], b"[" * depth, b'{"frames":' * depth)
    texts += (whole.decode().encode("utf-16"), b"", rng.randbytes(999), b"9" * 500, b'{"frames": [' + b"{}," * 99999)
    (folder / "transforms.json").write_bytes(rng.choice(texts))


def _png(width: int, height: int) -> bytes:
    """A picture of a few bytes that announces any size."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(10_000_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def _picture(rng: random.Random, folder: Path) -> None:
    path = rng.choice(sorted(folder.rglob("*.png")))
    whole = bytearray(path.read_bytes())
    kind = rng.randrange(6)
    if kind == 0:
        path.write_bytes(whole[: rng.randrange(len(whole))])
    elif kind == 1:
        for _ in range(rng.choice((1, 10))):
            whole[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(whole)
    elif kind == 2:
        side = rng.choice((1, 9000, 13_000, 60_000, 2**31 - 1))
        path.write_bytes(_png(side, side))
        tree = _json(folder) if (folder / "transforms.json").exists() else None
        if tree is not None and rng.random() < 0.7:  # the camera agrees
            tree |= {"w": side, "h": side}
            (folder / "transforms.json").write_text(json.dumps(tree))
    elif kind == 3:
        path.unlink()
        path.mkdir() if rng.random() < 0.5 else os.mkfifo(path)
    elif kind == 4:
        path.write_bytes(rng.randbytes(2000))
    else:
        path.unlink()


def _points(rng: random.Random, folder: Path) -> None:
    """A point cloud that belongs to the capture."""
    count = rng.choice(("3", "-1", "4000000000", "9" * 30))
    kind = rng.choice(("float", "list uchar float", "double"))
    format = rng.choice(("ascii", "binary_little_endian"))
    properties = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    head = f"ply\nformat {format} 1.0\nelement vertex {count}\n{properties}end_header\n"
    body = rng.choice((b"1 2 3\n" * 3, rng.randbytes(99), b""))
    (folder / "points3d.ply").write_bytes(head.encode() + body)


def _model(rng: random.Random, folder: Path) -> None:
    """A file of a sparse model."""
    file = rng.choice(sorted(path for path in (folder / "sparse/0").iterdir()))
    data = bytearray(file.read_bytes())
    kind = rng.randrange(5)
    if kind == 0:
        file.write_bytes(data[: rng.randrange(len(data))])
    elif kind == 1:
        for _ in range(rng.choice((1, 3, 20))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        file.write_bytes(data)
    elif kind == 2:
        file.write_bytes(rng.choice((b"", rng.randbytes(500), b"\xff" * 400)))
    elif kind == 3:
        data[:8] = struct.pack("<Q", rng.choice((0, 2**31, 2**63, 2**64 - 1)))
        file.write_bytes(data)
    else:
        file.unlink()
        if rng.random() < 0.6:
            file.mkdir() if rng.random() < 0.5 else os.mkfifo(file)


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed: most are read with all pictures, some trained for a step."""
    for number in range(count):
        rng = random.Random(f"capture {seed} {number}")
        colmap = rng.random() < 0.4
        change = rng.choice(
            (_model, _model, _picture) if colmap else (_field, _field, _field, _text, _picture, _points)
        )
        command = "train" if rng.random() < 0.08 else "look"

        def make(
            folder: Path, rng: random.Random = rng, change: Change = change, colmap: bool = colmap, name: str = command
        ) -> list[str]:
            poses, names = TOOLS.cameras(4), [f"images/{k}.png" for k in range(4)]
            if colmap:
                TOOLS.write_colmap(folder, poses, [Path(file).name for file in names], binary=rng.random() < 0.6)
            else:
                TOOLS.write_transforms(folder, poses, names)
            change(rng, folder)
            if name == "look":
                return [str(folder)]
            quick = ROOT / "configs/train/quick_cpu.yaml"
            given = ["fit", "--config", str(quick), "--trainer.max_steps", "1", "--trainer.default_root_dir", "out"]
            given += ["--data", "CaptureDataModule", "--data.init_args.path", str(folder)]
            return [*given, "--data.init_args.workers", "0", "--data.init_args.point_count", "50"]

        yield Case("capture", f"{number} {change.__name__.strip('_')}", command, make)
