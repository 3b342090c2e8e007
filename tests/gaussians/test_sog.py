"""SOG: as it was within the bits of each field, as others write it, in every packaging, and what is refused."""

import io
import json
import math
import re
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from other_writers import FILES, assert_same, in_order, members, packed, refused, scene
from PIL import Image
from shared import seeded, user_warning, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians import sog
from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians
from gaussian_swaying.gaussians.sog import read_sog
from gaussian_swaying.simulation.body import Scene

# a component has steps of sqrt(2) / 255, and three of them are off; the fourth, at least 1/2, follows from them
STEP = 2**0.5 / 255
QUATS = 2 * 2 * 0.5 * STEP * 3**0.5
ROUNDED = {"opacities": 0.501 / 255, "quats": QUATS}
CUT_OFF = {"opacities": 1.01 / 255, "quats": 2 * QUATS}  # where a writer does not round


def _meta(path):
    return json.loads(members(path)["meta.json"])


@pytest.mark.parametrize("degree", [0, 1])
def test_values_lie_on_the_nearest_entry_of_a_code_book(degree, tmp_path):
    cloud = varied_cloud(degree=degree)
    export_cloud(tmp_path / "a.sog", cloud)
    found = in_order(read_gaussians(tmp_path / "a.sog"), cloud)
    meta = _meta(tmp_path / "a.sog")
    assert meta["count"] == 300
    for name, before, after in (("scales", cloud.scales, found.scales), ("sh0", cloud.sh[:, 0], found.sh[:, 0])):
        book = torch.tensor(meta[name]["codebook"])
        assert len(book) == 256
        nearest = (before[..., None] - book).abs().amin(-1)
        assert_close((before - after).abs(), nearest, rtol=0, atol=1e-6)
    assert ("shN" in meta) == (degree > 0)


def test_values_that_fit_into_a_code_book_are_exact(tmp_path):
    """A flat white sheet of equal Gaussians: no range is empty for the writer."""
    cloud = varied_cloud(20, degree=0)
    cloud.means[:, 2], cloud.sh[:], cloud.scales[:] = 0.25, 1.0, -3.0
    export_cloud(tmp_path / "a.sog", cloud)
    found = read_gaussians(tmp_path / "a.sog")
    assert_close(found.means[:, 2], torch.full((20,), 0.25))
    assert (found.scales == -3).all()
    assert (found.sh == 1).all()
    one = cloud.select(torch.arange(1))
    export_cloud(tmp_path / "b.sog", one)
    assert_same(read_gaussians(tmp_path / "b.sog"), one, means=1e-6, scales=0, colors=0, sh=0, **ROUNDED)


def test_as_splat_transform_writes_it():
    """Axes are those of the .ply. It cuts values off, and its code books are for more Gaussians than these."""
    found = in_order(read_sog(FILES / "scene.sog"), scene())
    assert_same(found, scene(), means=1.5e-4, scales=0.02, colors=0.01, sh=0.01, **CUT_OFF)


def _unpacked(folder, files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / "meta.json"


def test_a_folder_is_what_a_bundle_holds(tmp_path):
    path = _unpacked(tmp_path / "in", members(FILES / "scene.sog"))
    bundle, folder = read_sog(FILES / "scene.sog"), read_gaussians(path)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(folder, name), getattr(bundle, name))
    export_cloud(tmp_path / "again.sog", read_gaussians(path))
    assert len(Scene(ply=tmp_path / "again.sog").cloud()) == 16


def _streamed(folder, change=lambda meta: None):
    """A streamed scene: two files for the finest level, of which a part is in no leaf, and one for the next."""
    whole = varied_cloud(30, degree=1)
    parts = {
        "0_0": whole.select(torch.arange(20)),
        "0_1": whole.select(torch.arange(20, 30)),
        "1_0": varied_cloud(5, 1),
    }
    for name, cloud in parts.items():
        (folder / name).mkdir(parents=True)
        export_cloud(folder / name / "a.sog", cloud)
        _unpacked(folder / name, members(folder / name / "a.sog"))

    def leaf(file, offset, count, **others):
        return {"lods": {"0": {"file": file, "offset": offset, "count": count}, **others}}

    meta = {
        "lodLevels": 2,
        "filenames": ["0_0/meta.json", "0_1/a.sog", "1_0/meta.json"],
        "tree": {
            "children": [
                leaf(0, 0, 12, **{"1": {"file": 2, "offset": 0, "count": 5}}),
                {"children": [leaf(1, 0, 10), leaf(0, 14, 6)]},
            ]
        },
    }
    change(meta)
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder / "lod-meta.json", parts


def test_one_level_of_a_streamed_scene(tmp_path):
    """The finest, unless told otherwise; ranges of the files in place of whole ones."""
    path, parts = _streamed(tmp_path)
    first = read_sog(tmp_path / "0_0" / "meta.json")
    found = read_gaussians(path)
    assert len(found) == 28
    assert torch.equal(found.means[:12], first.means[:12])
    assert torch.equal(found.means[12:18], first.means[14:])
    assert torch.equal(found.sh[18:], read_sog(tmp_path / "0_1" / "a.sog").sh)
    assert len(read_sog(path, level=1)) == len(parts["1_0"]) == 5
    with value_error("has the levels 0 to 1, but level 2 was asked for"):
        read_sog(path, level=2)
    path.write_text(path.read_text().replace("{", '{"environment": "env/meta.json", ', 1))
    with user_warning("left out its environment, 'env/meta.json'"):
        assert len(read_gaussians(path)) == 28


def _leaf(meta):
    return meta["tree"]["children"][0]["lods"]["0"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("tree"), "it has no `tree`"),
        (lambda m: m["tree"].update(children=[]), "zero Gaussians at level 0"),
        (lambda m: _leaf(m).update(count=-1), "wants Gaussians 0 to -2 of 20"),
        (lambda m: _leaf(m).update(count=15), "`tree` wants Gaussians 14 to 19 of 20"),
        (lambda m: _leaf(m).update(offset=19), "`tree` wants Gaussians 19 to 30 of 20"),
        (lambda m: m.update(filenames=["../x/meta.json"] * 3), "names the file '../x/meta.json'; put all files"),
        (lambda m: m.update(filenames=["/meta.json"] * 3), "names the file '/meta.json'"),
        (lambda m: m.update(filenames=["http://a/b"] * 3), "names the file 'http://a/b'"),
        (lambda m: m.update(filenames=["C:\\b"] * 3), "names the file"),
        (lambda m: m.update(filenames=["lod-meta.json"] * 3), "names lod-meta.json as a part of itself"),
    ],
)
def test_bad_streams(change, message, tmp_path):
    refused(_streamed(tmp_path, change)[0], message)


def _picture(width, height, value=0):
    content = io.BytesIO()
    Image.fromarray(np.full((height, width, 4), value, np.uint8)).save(content, "WEBP", lossless=True, exact=True)
    return content.getvalue()


def _set(place, value):
    """Sets an entry of meta.json, such as `means mins`."""

    def change(files):
        meta = part = json.loads(files["meta.json"])
        *path, last = place.split()
        for word in path:
            part = part[word]
        part[last] = value
        files["meta.json"] = json.dumps(meta).encode()

    return change


def test_bad_files(tmp_path):
    for change, message in (
        (lambda f: f.pop("quats.webp"), "no item named 'quats.webp'"),
        (_set("version", 1), "is not SOG of version 2"),
        (_set("count", 10**9), "announces a `count` of 1,000,000,000 Gaussians, far"),
        (_set("count", 40), "has 4 x 4 pixels, but `count` asks for 40"),
        (_set("means maxs", [30, 0, 0]), "beyond ±1e+12 for"),
        (_set("scales codebook", [1.0]), "out of bounds"),
        (_set("scales codebook", [1e4] * 256), "`scale_2` is NaN or infinite"),
        (_set("shN count", 70000), "has 960 x 1 pixels, but `count` asks for 1,050,000"),
        (_set("shN bands", 4), "index out of range"),
        (_set("shN", []), "is not a usable SOG file"),
        (lambda f: f.update({"quats.webp": b"RIFF"}), "cannot identify image file"),
        (lambda f: f.update({"quats.webp": _picture(4, 4)}), "a pixel of `quats` among these is no rotation"),
    ):
        files = members(FILES / "scene.sog")
        change(files)
        refused(packed(tmp_path / "bad.sog", files), message)
        refused(_unpacked(tmp_path, files), "" if "no item" in message else message, name=str(tmp_path))


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_only_what_programs_write_is_unpacked(method, tmp_path):
    """A damaged stream of another kind can end in any error, or ask for any memory."""
    with zipfile.ZipFile(tmp_path / "bad.sog", "w", method) as archive:
        archive.writestr("meta.json", b"{}")
    refused(tmp_path / "bad.sog", "is compressed by other means than deflate")


def test_the_count_is_that_of_the_pictures(tmp_path):
    """Of 290 Gaussians in 300 pixels, the others of which this program makes white and others black."""
    export_cloud(tmp_path / "a.sog", varied_cloud(290))
    for count in (291, 300):
        files = members(tmp_path / "a.sog")
        _set("count", count)(files)
        refused(packed(tmp_path / "bad.sog", files), f"`count` is {count}, but", "no rotation")


def test_a_code_book_may_hold_what_is_no_number(tmp_path):
    """What has it is left out, or flat."""
    export_cloud(tmp_path / "a.sog", varied_cloud())
    for place, value, words, left in (
        ("sh0 codebook", math.nan, "`f_dc_*` or `f_rest_*` is NaN or infinite", 0),
        ("scales codebook", -math.inf, "have a size of zero, and become flat", 300),
    ):
        files = members(tmp_path / "a.sog")
        book = json.loads(files["meta.json"])[place.split()[0]]["codebook"]
        _set(place, [value, *book[1:]])(files)
        with user_warning(re.escape(words)):
            found = read_gaussians(packed(tmp_path / "b.sog", files))
        assert left <= len(found) <= 300


def test_nothing_swells(tmp_path):
    """A bundle of a few kilobytes can hold gigabytes of zeros, and a small picture millions of pixels."""
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members(FILES / "scene.sog").items():
            archive.writestr(name, content)
        with archive.open("more", "w", force_zip64=True) as entry:
            for _ in range(1300):
                entry.write(bytes(1 << 20))
    files = members(FILES / "scene.sog") | {"sh0.webp": _picture(8000, 8000)}
    packed(tmp_path / "b.sog", files)
    for name, message in (("a.sog", "announces 9 files, far more than its"), ("b.sog", "has 8000 x 8000 pixels")):
        assert (tmp_path / name).stat().st_size < 1 << 21
        tracemalloc.start()
        refused(tmp_path / name, message)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
        tracemalloc.stop()


def test_files_elsewhere_are_not_read(tmp_path):
    path = _unpacked(tmp_path / "in", members(FILES / "scene.sog"))
    (tmp_path / "quats.webp").write_bytes((path.parent / "quats.webp").read_bytes())
    path.write_text(path.read_text().replace("quats.webp", "../quats.webp"))
    refused(path, "names the file '../quats.webp'; put all files into its folder")


def test_the_mark_of_antialiasing(tmp_path):
    files = members(FILES / "scene.sog")
    _set("model", "antialiased")(files)
    with user_warning("trained with antialiasing"):
        read_gaussians(packed(tmp_path / "a.sog", files))


def test_more_harmonics_than_a_file_can_hold(tmp_path, monkeypatch):
    """Similar ones become one: close to their noise where there are patterns, and no more sets than allowed."""
    monkeypatch.setattr(sog, "PALETTE", 1024)
    draw = seeded(1)
    cloud = varied_cloud(4000, degree=2)
    pattern = torch.randint(0, 300, (4000,), generator=draw)
    clean = torch.randn(300, 9, 3, generator=draw)[pattern]
    cloud = replace(cloud, sh=(clean + 0.01 * torch.randn(4000, 9, 3, generator=draw)).clone())
    export_cloud(tmp_path / "a.sog", cloud)
    assert 256 < _meta(tmp_path / "a.sog")["shN"]["count"] <= 1024
    found = in_order(read_gaussians(tmp_path / "a.sog"), cloud)
    off = (found.sh - cloud.sh)[:, 1:].square().mean().sqrt()
    assert off < 0.05  # of harmonics that vary by 1
    same = replace(cloud, sh=torch.ones_like(cloud.sh))
    export_cloud(tmp_path / "b.sog", same)
    assert_close(read_gaussians(tmp_path / "b.sog").sh, same.sh)


def test_large_code_books_are_made_from_a_sample(monkeypatch):
    monkeypatch.setattr(sog, "_SAMPLE", 1000)
    values = np.random.default_rng(0).normal(size=(5000, 3))
    book, near = sog._coded(values)
    assert len(book) == 256
    assert np.abs(np.array(book)[near] - values).mean() < 0.02
    assert np.abs(np.array(book)[near] - values).max() < 0.5


def test_too_many_for_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(sog, "LARGEST_SIDE", 8)
    export_cloud(tmp_path / "a.sog", varied_cloud(64, degree=0))
    with value_error(r"A \.sog file holds up to 64 Gaussians, but there are 65: choose spz"):
        export_cloud(tmp_path / "b.sog", varied_cloud(65, degree=0))
    assert [path.name for path in tmp_path.iterdir()] == ["a.sog"]
