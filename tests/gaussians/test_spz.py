"""SPZ of all versions: as it was within the bits of each field, as others write it, and what is refused."""

import contextlib
import gzip
import math
import struct
import tracemalloc

import numpy as np
import pytest
import torch
from other_writers import FILES, assert_same, refused, scene, turned
from shared import near, user_warning, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying._inputs import spare_memory
from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians
from gaussian_swaying.gaussians.spz import encode_spz, read_spz

from .test_round_trips import SMALLEST_THREE, SPZ

needs_zstandard = pytest.importorskip("zstandard")  # of version 4


@pytest.mark.parametrize("version", [3, 4])
def test_as_splat_transform_writes_it(version):
    """It turns the axes of a .ply (y down) to y up, with 12 bits behind the point, and rounds as Niantic does."""
    found = read_spz(FILES / f"scene_v{version}.spz")
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    assert_same(turned(found, half_turn), scene(), **SPZ | {"means": 1.01 * 2.0**-13, "quats": SMALLEST_THREE})
    assert torch.equal(read_spz(FILES / "scene_v3.spz").sh, read_spz(FILES / "scene_v4.spz").sh)


def test_the_same_bytes_as_the_official_writer(tmp_path):
    """Everything but the centres, which have more bits here: the rest of a file is what Niantic's code makes of it."""
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    mine = gzip.decompress(encode_spz(turned(scene(), half_turn), 3))
    theirs = gzip.decompress((FILES / "scene_v3.spz").read_bytes())
    assert mine[:13] == theirs[:13]
    assert len(mine) == len(theirs)
    alphas, rotations, rest = 16 + 16 * 9, 16 + 16 * (9 + 7), 16 + 16 * (9 + 11)
    assert mine[alphas:rotations] == theirs[alphas:rotations]
    assert mine[rest:] == theirs[rest:]


def test_by_hand(tmp_path):
    """A file of version 1 and one of version 2, whose values follow from the description of the format."""
    head = struct.pack("<4sIIBBBB", b"NGSP", 1, 1, 0, 12, 0, 0)
    rest = bytes([51, 0, 255, 128, 160, 0, 255, 255, 128, 0])  # opacity, colour, sizes, rotation
    (tmp_path / "1.spz").write_bytes(gzip.compress(head + np.float16([0.5, -2, 3]).tobytes() + rest))
    (tmp_path / "2.spz").write_bytes(
        gzip.compress(head.replace(b"P\x01", b"P\x02") + bytes([0, 8, 0, 0, 0xE0, 0xFF, 0, 0x30, 0]) + rest)
    )
    for name in ("1.spz", "2.spz"):
        cloud = read_gaussians(tmp_path / name)
        assert cloud.means.tolist() == [[0.5, -2.0, 3.0]]
        assert_close(cloud.opacities.sigmoid(), torch.tensor([0.2]))
        assert_close(cloud.sh, torch.tensor([[[-10.0, 10.0, (128 / 255 - 0.5) * 20]]]) / 3)
        assert cloud.scales.tolist() == [[0.0, -10.0, 5.9375]]
        assert_close(cloud.quats, torch.tensor([[0.0, 1.0, 1 / 255, -1.0]]))


def test_far_away_and_tiny(tmp_path):
    """The point moves for large scenes; sizes end at exp(-10); what does not fit is refused, and nothing is left."""
    cloud = varied_cloud(20, degree=0)
    cloud.means[3, 1], cloud.scales[5] = 1e5, -16.0
    with user_warning("1 of 20 Gaussians have a size below 4.5e-05"):
        export_cloud(tmp_path / "a.spz", cloud)
    found = read_gaussians(tmp_path / "a.spz")
    near(found.means, cloud.means, 2.0**-7)
    assert found.scales[5].tolist() == [-10.0] * 3
    cloud.means[3, 1] = 1e7
    with value_error(r"centres up to ±8e6, but one is at 1e[+]07: remove"):
        export_cloud(tmp_path / "b.spz", cloud)
    with value_error("`spz_version` to be 2, 3 or 4, but got 5"):
        export_cloud(tmp_path / "b.spz", cloud, spz_version=5)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"]


def _body(change=lambda head: None, version=3, degree=0):
    data = encode_spz(varied_cloud(2, degree=degree), version)
    data = bytearray(data if version == 4 else gzip.decompress(data))
    change(data)
    return bytes(data)


def _put(place, kind, value):
    return lambda data: struct.pack_into(kind, data, place, value)


def test_flags_and_extensions_are_told(tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(_body(_put(14, "B", 1))))
    with user_warning("trained with antialiasing"):
        read_gaussians(path)
    axes = struct.Struct("<IIIIII")  # an extension that is not known, and that of the axes
    for number, good in (
        (6, True),
        (4, True),
        (0, True),
        (8, False),
        (3, False),
        (12, True),
        (16, False),
        (9, True),
        (10, False),
    ):
        extensions = axes.pack(7, 4, 0, 0xADBE0003, 4, number)
        path.write_bytes(gzip.compress(_body(_put(14, "B", 2)) + extensions))
        if good:
            assert len(read_gaussians(path)) == 2
        else:
            with value_error(rf"left-handed axes \(number {number}\)"):
                read_gaussians(path)
    data = _body(_put(14, "B", 2), version=4)
    struct.pack_into("<I", longer := bytearray(data), 16, 32 + axes.size)
    path.write_bytes(longer[:32] + axes.pack(7, 4, 0, 0xADBE0003, 4, 8) + longer[32:])
    refused(path, "left-handed")
    far = struct.pack("<II5000xIII", 7, 5000, 0xADBE0003, 4, 8)
    path.write_bytes(gzip.compress(_body(_put(14, "B", 2)) + far))
    refused(path, "left-handed")
    path.write_bytes(gzip.compress(_body(_put(14, "B", 2)) + far[:-9]))
    refused(path, "is not a usable .spz file")


def test_harmonics_of_degree_4(tmp_path):
    """What is above degree 3 is left out, with a warning."""
    cloud = varied_cloud(2, degree=3)
    data = bytearray(gzip.decompress(encode_spz(cloud)))
    data[12] = 4
    rest = np.frombuffer(bytes(data[-90:]), "u1").reshape(2, 45)
    wider = np.concatenate([rest, np.full((2, 27), 7, "u1")], axis=1)
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data[:-90]) + wider.tobytes()))
    with user_warning("ignored the harmonics of degree 4"):
        found = read_gaussians(tmp_path / "a.spz")
    near(found.sh, cloud.sh, 0.1)


def test_bad_files(tmp_path):
    path = tmp_path / "bad.spz"
    good, behind = (
        gzip.compress(_body(degree=1)),
        "bytes (`version` {}, `count` {}, ",
    )
    for data, message in (
        (gzip.compress(_body(_put(8, "<I", 1))), behind.format(3, 1)),
        (gzip.compress(_body(_put(12, "B", 0), degree=1)), behind.format(3, 2)),
        (gzip.compress(_body(_put(4, "<I", 2))), behind.format(2, 2)),
        (gzip.compress(_body(_put(4, "<I", 4))), "`version` 4 is not compressed by gzip"),
        (_body(_put(4, "<I", 3), version=4), "`version` 1 to 3 is compressed by gzip"),
        (gzip.compress(_body(_put(13, "B", 25))), "`fractional_bits` 25"),
        (good[:-8], "ended before the end-of-stream marker"),
        (good[:-3], "ended before the end-of-stream marker"),
        (good[:-8] + bytes(8), "CRC check failed"),
        (good + b"more", "Not a gzipped file"),
        (_body(version=4) + b"\0", behind.format(4, 2)),
        (_body(_put(16, "<I", 40), version=4), "is not a usable .spz file"),
        (_body(version=4)[:37], "is not a usable .spz file"),
        (b"#\n", "starts neither as gzip nor with `NGSP`"),
        (b"\x1f\x8b" + bytes(40), "Unknown compression method"),
        (gzip.compress(_body()[:-3]), "announces 40 bytes (`version` 3, `count` 2, `degree` 0), but 37 bytes"),
        (gzip.compress(_body(_put(4, "<I", 9))), "`version` 9"),
        (gzip.compress(_body(_put(8, "<I", 0))), "zero Gaussians"),
        (gzip.compress(_body(_put(8, "<I", 2**32 - 1))), "announces a `count` of 4,294,967,295 Gaussians, far more"),
        (gzip.compress(_body(_put(8, "<I", 100_000))), "announces 2,000,000 bytes"),
        (gzip.compress(_body(_put(12, "B", 5))), "harmonics of degree 5"),
        (_body(_put(32, "<Q", 2**63), version=4), "is not a usable .spz file"),
    ):
        path.write_bytes(data)
        refused(path, message)


def test_no_more_is_decompressed_than_announced(tmp_path):
    """A few bytes of gzip or Zstandard can stand for gigabytes, in what is announced and behind it."""
    (tmp_path / "a.spz").write_bytes(gzip.compress(_body() + bytes(1 << 26)))
    data = _body(version=4)
    bomb = needs_zstandard.ZstdCompressor().compress(bytes(1 << 26))
    struct.pack_into("<Q", longer := bytearray(data), 32, len(bomb))
    old = struct.unpack_from("<Q", data, 32)[0]
    (tmp_path / "b.spz").write_bytes(longer[:112] + bomb + longer[112 + old :])
    for name in ("a.spz", "b.spz"):
        tracemalloc.start()
        refused(tmp_path / name, "its header announces")
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
        tracemalloc.stop()


def _bomb(count):
    """A file of version 4 whose Gaussians are all the same: 10 kB for each gigabyte."""
    whole = needs_zstandard.ZstdCompressor(level=19)
    parts = [whole.compress(bytes([144]) * (count * size)) for size in (9, 1, 3, 3, 4)]
    table = [struct.pack("<QQ", len(part), count * size) for part, size in zip(parts, (9, 1, 3, 3, 4), strict=True)]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32)
    return b"".join([head, *table, *parts])


@pytest.mark.parametrize(("count", "spare"), [(10_000_000, None), (400_000, 1 << 26)])
def test_few_bytes_cannot_take_much_memory(count, spare, tmp_path):
    (tmp_path / "a.spz").write_bytes(_bomb(count))
    assert (tmp_path / "a.spz").stat().st_size < 20_000
    tracemalloc.start()
    with spare_memory(spare) if spare else contextlib.nullcontext():
        refused(tmp_path / "a.spz", f"announces a `count` of {count:,} Gaussians, far more than its")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    if spare:
        assert len(read_gaussians(tmp_path / "a.spz")) == count


def test_values_that_cannot_be_used(tmp_path):
    """An opacity of 1 ends half a step below."""
    cloud = varied_cloud(20)
    cloud.opacities[5] = math.inf
    export_cloud(tmp_path / "b.spz", cloud)
    assert float(read_gaussians(tmp_path / "b.spz").opacities.max()) == pytest.approx(math.log(509), abs=1e-4)


def test_without_zstandard_is_one_sentence(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(ImportError, match=r"zstandard: run pip install 'gaussian-swaying\[spz\]', or choose version 3"):
        export_cloud(tmp_path / "a.spz", varied_cloud(4), spz_version=4)
    with pytest.raises(ImportError, match=r"scene_v4\.spz is of version 4 of SPZ and needs zstandard: run pip"):
        read_gaussians(FILES / "scene_v4.spz")
    export_cloud(tmp_path / "b.spz", varied_cloud(4))
    assert [path.name for path in tmp_path.iterdir()] == ["b.spz"]
