"""Malformed .ply files: headers that lie, numbers that are none, and bytes at random."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from sandbox import Case
from small import SMALL, splat_bytes

COUNTS = (
    "-200",
    "-1",
    "0",
    "1",
    "99",
    "1000000",
    "2147483648",
    "4294967295",
    "9223372036854775808",
    "9" * 400,
    "x",
    "",
)
TYPES = ("double", "uchar", "int", "list uchar float", "list uint double", "list char int", "quad", "string", "")
NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1e30, 3e38, 1e-38, 88.8, -104.0, 1e10, 0.0)
Change = Callable[[random.Random, bytes, bytes], bytes]


def _line(rng: random.Random, head: bytes) -> int:
    return rng.randrange(head.count(b"\n") - 1)


def _edit(head: bytes, index: int, line: bytes | None) -> bytes:
    lines = head.split(b"\n")
    lines[index : index + 1] = [] if line is None else [line]
    return b"\n".join(lines)


def _count(rng: random.Random, head: bytes, body: bytes) -> bytes:
    return re.sub(rb"element vertex \d+", b"element vertex " + rng.choice(COUNTS).encode(), head) + body


def _type(rng: random.Random, head: bytes, body: bytes) -> bytes:
    names = re.findall(rb"property float (\w+)", head)
    name = rng.choice(names)
    return head.replace(b"property float " + name, b"property " + rng.choice(TYPES).encode() + b" " + name, 1) + body


def _drop(rng: random.Random, head: bytes, body: bytes) -> bytes:
    return _edit(head, _line(rng, head), None) + body


def _twice(rng: random.Random, head: bytes, body: bytes) -> bytes:
    index = _line(rng, head)
    line = head.split(b"\n")[index]
    return _edit(head, index, line + b"\n" + line) + body


def _garble(rng: random.Random, head: bytes, body: bytes) -> bytes:
    line = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 60)))
    return _edit(head, _line(rng, head), line) + body


def _extra(rng: random.Random, head: bytes, body: bytes) -> bytes:
    element = f"element face {rng.choice(COUNTS)}\nproperty {rng.choice(TYPES)} vertex_indices\n".encode()
    place = head.index(b"element vertex") if rng.random() < 0.5 else head.index(b"end_header")
    return head[:place] + element + head[place:] + body


def _format(rng: random.Random, head: bytes, body: bytes) -> bytes:
    other = rng.choice((b"ascii 1.0", b"binary_big_endian 1.0", b"binary_little_endian 9", b"", b"utf-8"))
    return head.replace(b"binary_little_endian 1.0", other) + body


def _flip(rng: random.Random, head: bytes, body: bytes) -> bytes:
    data = bytearray(head + body)
    end = len(head) if rng.random() < 0.5 else len(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        data[rng.randrange(end)] ^= 1 << rng.randrange(8)
    return bytes(data)


def _cut(rng: random.Random, head: bytes, body: bytes) -> bytes:
    data = head + body
    return data[: rng.randrange(len(data))] if rng.random() < 0.8 else data + bytes(rng.randrange(1, 999))


def _numbers(rng: random.Random, head: bytes, body: bytes) -> bytes:
    count = int(re.search(rb"element vertex (\d+)", head)[1])  # type: ignore[index]
    table = np.frombuffer(body, "<f4").reshape(count, -1).copy()
    rows = slice(None) if rng.random() < 0.2 else rng.sample(range(count), rng.choice((1, 1, 5)))
    for _ in range(rng.choice((1, 1, 4))):
        table[rows, rng.randrange(table.shape[1])] = rng.choice(NUMBERS)
    return head + table.tobytes()


def _noise(rng: random.Random, head: bytes, body: bytes) -> bytes:
    return head + rng.randbytes(len(body)) if rng.random() < 0.7 else rng.randbytes(rng.randrange(4000))


CHANGES: tuple[Change, ...] = (
    _count, _type, _drop, _twice, _garble, _extra, _format, _flip, _cut, _numbers, _numbers, _noise
)  # fmt: skip


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed: most are exported, which is quick, some simulated and looked at."""
    for number in range(count):
        rng = random.Random(f"ply {seed} {number}")
        change = rng.choice(CHANGES)
        command = rng.choices(("export", "sim", "preview"), (6, 2, 1))[0]

        def make(folder: Path, rng: random.Random = rng, change: Change = change, command: str = command) -> list[str]:
            head, mark, body = splat_bytes().partition(b"end_header\n")
            (folder / "bad.ply").write_bytes(change(rng, head + mark, body))
            path = str(folder / "bad.ply")
            more = {"export": [path, "out.splat"], "preview": [path, "--device", "cpu", "--height", "64"]}
            return more.get(command) or [*SMALL, "--scene.ply", path]

        yield Case("ply", f"{number} {change.__name__.strip('_')}", command, make)
