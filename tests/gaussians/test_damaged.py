"""Files that were damaged: none ends in anything but a sentence with its name, or a cloud that can be used."""

import gzip
import io
import json
import random
import re
import struct
import tracemalloc
import warnings

import pytest
import torch
from damage import changed, damaged
from other_writers import FILES, glb, glb_parts, members, packed, scene

from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians

LINES = (
    b"element vertex 4000000000", b"element vertex -1", b"element vertex 9223372036854775808", b"element face 3",
    b"property list uint double x", b"property quad x", b"property float x", b"format ascii 1.0",
    b"format binary_big_endian 1.0", b"end_header", b"comment " + b"long " * 20_000, b"\xff\xfe",
)  # fmt: skip


def _read(name):
    return (FILES / name).read_bytes()


def _header(rng):
    """A header with a line that is another, missing or there twice."""
    head, mark, body = _read("scene.ply").partition(b"end_header\n")
    lines = head.splitlines()
    at = rng.randrange(len(lines))
    lines[at : at + 1] = rng.choice(([], [lines[at]] * 2, [rng.choice(LINES)], [rng.choice(LINES), lines[at]]))
    return b"\n".join(lines) + b"\n" + mark + body


def _numbers(rng):
    head, mark, body = _read("scene.ply").partition(b"end_header\n")
    data = bytearray(body)
    for _ in range(rng.choice((1, 4))):
        value = rng.choice((float("nan"), float("inf"), 1e30, -1e30, 3e38, 88.8, -104.0, 0.0))
        struct.pack_into("<f", data, 4 * rng.randrange(len(data) // 4), value)
    return head + mark + bytes(data)


def _glb(rng):
    document, data = glb_parts(_read("scene.glb"))
    return glb(changed(rng, document), data)


def _sog(rng):
    files = members(FILES / "scene.sog")
    name = rng.choice(["meta.json", "meta.json", *files])
    if name == "meta.json":
        files[name] = json.dumps(changed(rng, json.loads(files[name]))).encode()
    else:
        files[name] = damaged(rng, files[name])
    return packed(io.BytesIO(), files).getvalue()


DAMAGES = {
    "ply": (".ply", lambda rng: damaged(rng, _read("scene.ply"))),
    "header": (".ply", _header),
    "numbers": (".ply", _numbers),
    "gzip": (".spz", lambda rng: damaged(rng, _read("scene_v3.spz"))),
    "spz": (".spz", lambda rng: gzip.compress(damaged(rng, gzip.decompress(_read("scene_v3.spz"))))),
    "zstandard": (".spz", lambda rng: damaged(rng, _read("scene_v4.spz"))),
    "glb": (".glb", lambda rng: damaged(rng, _read("scene.glb"))),
    "gltf": (".glb", _glb),
    "zip": (".sog", lambda rng: damaged(rng, _read("scene.sog"))),
    "sog": (".sog", _sog),
    "compressed": (".compressed.ply", None),
    "splat": (".splat", None),
}


def _try(path, case):
    told = None
    tracemalloc.start()
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            cloud = read_gaussians(path)
    except (ValueError, FileNotFoundError) as error:
        told = str(error)
    finally:
        assert tracemalloc.get_traced_memory()[1] < 1 << 26, case
        tracemalloc.stop()
    if told is not None:
        assert re.fullmatch(r".*(bad\.|does not exist).*", told), (case, told)
        return True
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.isfinite(getattr(cloud, name)).all(), (case, name)
    return bool(warned)


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_file_is_refused_in_one_sentence_or_is_a_cloud(kind, count, tmp_path):
    """In little memory, and with numbers that can be drawn."""
    suffix, spoil = DAMAGES[kind]
    path = tmp_path / f"bad{suffix}"
    if spoil is None:
        export_cloud(path, scene())
        whole = path.read_bytes()
    refused = 0
    for number in range(count):
        rng = random.Random(f"{kind} {number}")
        path.write_bytes(damaged(rng, whole) if spoil is None else spoil(rng))
        refused += _try(path, number)
    assert refused > count / 20
