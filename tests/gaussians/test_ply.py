"""The 3DGS .ply file: what is written comes back, other tools' files are understood, bad ones are explained."""

import os
import re

import numpy as np
import pytest
import torch
from other_writers import refused
from plyfile import PlyData, PlyElement
from shared import near, silent, user_warning, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying._ply_table import element_parts, read_element, read_header
from gaussian_swaying.gaussians import ply as ply_module
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.ply import read_ply, write_ply
from gaussian_swaying.geometry.patches import smallest_axis_normal

REST = {0: 0, 1: 9, 2: 24, 3: 45}
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def _columns(degree=0, count=5, normals=True):
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals else []) + ["f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(REST[degree])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    draw = np.random.default_rng(0)
    return {name: draw.standard_normal(count).astype("f4") for name in names}


def _write(path, columns, byte_order="<", text=False, name="vertex"):
    count = len(next(iter(columns.values())))
    rows = np.empty(count, dtype=[(key, value.dtype.str.replace("<", "")) for key, value in columns.items()])
    for key, value in columns.items():
        rows[key] = value
    PlyData([PlyElement.describe(rows, name)], text=text, byte_order=byte_order).write(str(path))
    return path


def _assert_equal(actual, expected, fields=FIELDS):
    for field in fields:
        near(getattr(actual, field), getattr(expected, field), 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("normals", [False, True])
def test_round_trip_is_exact(tmp_path, degree, normals):
    cloud = varied_cloud(7, degree=degree, normals=normals)
    write_ply(tmp_path / "a.ply", cloud)
    with silent():
        back = read_ply(tmp_path / "a.ply")
    _assert_equal(back, cloud)
    assert back.sh_degree == degree
    assert all(getattr(back, field).dtype == torch.float32 for field in FIELDS)
    expected = cloud.normals if normals else smallest_axis_normal(cloud.quats, cloud.scales)
    near(back.normals, expected, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("kept", [0, 1, 3])
def test_harmonics_may_be_left_out(tmp_path, degree, kept):
    cloud = varied_cloud(7, degree=degree)
    write_ply(tmp_path / "a.ply", cloud)
    back, all_of_it = read_ply(tmp_path / "a.ply", kept), read_ply(tmp_path / "a.ply")
    assert back.sh_degree == min(degree, kept)
    assert torch.equal(back.sh, all_of_it.sh[:, : back.sh.shape[1]])
    assert torch.equal(back.quats, all_of_it.quats)
    assert torch.equal(read_gaussians(tmp_path / "a.ply", kept).sh, back.sh)


def test_a_file_is_read_in_parts(tmp_path, monkeypatch):
    cloud = varied_cloud(7, degree=1)
    write_ply(tmp_path / "a.ply", cloud)
    header = read_header(tmp_path / "a.ply")
    whole = read_element(tmp_path / "a.ply", header, "vertex")
    parts = list(element_parts(tmp_path / "a.ply", header, "vertex", 3))
    assert [len(part) for part in parts[:-1]] == [3] * (len(parts) - 1)
    assert len(parts) > 1
    assert np.array_equal(np.concatenate(parts), whole)
    monkeypatch.setattr(ply_module, "element_parts", lambda *given: iter(parts))
    assert torch.equal(read_ply(tmp_path / "a.ply").sh, cloud.sh)


def test_written_order_and_channels(tmp_path):
    """The order of Kerbl et al.'s save_ply, with f_rest by channel: all of red, then green, then blue."""
    cloud = varied_cloud(7, degree=1)
    write_ply(tmp_path / "a.ply", cloud)
    ply = PlyData.read(str(tmp_path / "a.ply"))
    vertex = ply["vertex"]
    names = [prop.name for prop in vertex.properties]
    assert names == list(_columns(degree=1))
    assert {prop.val_dtype for prop in vertex.properties} == {"f4"}
    assert ply.byte_order == "<"
    np.testing.assert_array_equal(vertex["f_rest_0"], cloud.sh[:, 1, 0])
    np.testing.assert_array_equal(vertex["f_rest_2"], cloud.sh[:, 3, 0])
    np.testing.assert_array_equal(vertex["f_rest_3"], cloud.sh[:, 1, 1])
    np.testing.assert_array_equal(vertex["f_rest_8"], cloud.sh[:, 3, 2])
    np.testing.assert_array_equal(vertex["rot_0"], cloud.quats[:, 0])


def test_write_casts_and_detaches(tmp_path):
    cloud = varied_cloud(7, 3).to(torch.float64)
    cloud.means.requires_grad_()
    write_ply(str(tmp_path / "a.ply"), cloud)
    _assert_equal(read_ply(str(tmp_path / "a.ply")), cloud.to(torch.float32))


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", varied_cloud(3, 3))
    old = (tmp_path / "a.ply").read_bytes()

    def fail(self, stream):
        with open(stream, "wb") as file:
            file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(PlyData, "write", fail)
    with pytest.raises(OSError, match="disk full"):
        write_ply(tmp_path / "a.ply", varied_cloud(4, 3))
    assert (tmp_path / "a.ply").read_bytes() == old
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_any_property_order_and_byte_order(tmp_path, degree, byte_order):
    columns = _columns(degree)
    names = np.random.default_rng(1).permutation(list(columns))
    expected = read_ply(_write(tmp_path / "a.ply", columns))
    shuffled = read_ply(_write(tmp_path / "b.ply", {name: columns[name] for name in names}, byte_order))
    _assert_equal(shuffled, expected, (*FIELDS, "normals"))
    np.testing.assert_array_equal(expected.means[:, 1], columns["y"])
    if degree == 2:
        np.testing.assert_array_equal(expected.sh[:, 8, 1], columns["f_rest_15"])


def test_double_properties_become_float32(tmp_path):
    columns = {name: value.astype("f8") for name, value in _columns().items()}
    _assert_equal(read_ply(_write(tmp_path / "a.ply", columns)), read_ply(_write(tmp_path / "b.ply", _columns())))


def test_zero_or_absent_normals_count_as_none(tmp_path):
    assert read_ply(_write(tmp_path / "a.ply", _columns(normals=False))).normals is None
    zero = _columns() | {name: np.zeros(5, "f4") for name in ("nx", "ny", "nz")}
    assert read_ply(_write(tmp_path / "b.ply", zero)).normals is None
    assert read_ply(_write(tmp_path / "c.ply", _columns())).normals.shape == (5, 3)


def test_extra_properties_are_named_once(tmp_path):
    columns = _columns() | {"red": np.arange(5, dtype="u1"), "label": np.arange(5, dtype="i4")}
    with user_warning(r"extra\.ply: ignored the properties red, label") as record:
        cloud = read_ply(_write(tmp_path / "extra.ply", columns))
    assert len(record) == 1
    _assert_equal(cloud, read_ply(_write(tmp_path / "plain.ply", _columns())))


def test_infinite_opacity_is_read_as_opaque(tmp_path):
    """Converters store an opacity of 1 as an infinite logit; it must not reach a loss or an optimiser."""
    columns = _columns()
    columns["opacity"][1:3] = np.inf, -np.inf
    cloud = read_ply(_write(tmp_path / "bad.ply", columns))
    assert cloud.opacities[1:3].tolist() == [16.0, -16.0]


def test_what_is_no_file(tmp_path):
    refused(tmp_path / "none.ply", "none.ply does not exist; check the path")
    refused(tmp_path, "is a directory; give the splat inside it")
    os.mkfifo(tmp_path / "pipe.ply")  # reading it would wait for ever
    refused(tmp_path / "pipe.ply", "not a regular file")


def _without(*names):
    return {key: column for key, column in _columns().items() if key not in names}


@pytest.mark.parametrize(
    ("columns", "options", "words"),
    [
        (
            _without("opacity", *(f"scale_{k}" for k in range(3)), "f_dc_0"),
            {},
            ["is a point cloud or a mesh, not a splat"],
        ),
        (_columns() | {"x": np.arange(5, dtype="i4")}, {}, ["property `x` is a whole number; export it as float"]),
        (_columns(), {"text": True}, ["ASCII", "export as binary"]),
        (_columns(), {"name": "face"}, ["no element `vertex` (elements: face)", "export it from a 3DGS tool"]),
        (_columns(count=0), {}, ["zero Gaussians", "export the scene again"]),
        *((_without(name), {}, [f"no property `{name}`"]) for name in ("x", "f_dc_1", "opacity", "scale_1", "rot_3")),
        (
            _columns() | {f"f_rest_{i}": np.zeros(5, "f4") for i in range(8)},
            {},
            ["8 properties `f_rest_*`", "0, 9, 24"],
        ),
        (_columns(1) | {"f_rest_4": None, "f_rest_9": np.zeros(5, "f4")}, {}, ["no property `f_rest_4`", "export it"]),
    ],
)
def test_not_a_scene(tmp_path, columns, options, words):
    columns = {name: column for name, column in columns.items() if column is not None}
    refused(_write(tmp_path / "bad.ply", columns, **options), *words)


def test_cut_off(tmp_path):
    path = _write(tmp_path / "bad.ply", _columns())
    path.write_bytes(path.read_bytes()[:-30])
    refused(path, "is truncated", "copy or export the file again")


BAD = [
    ("z", np.nan, "`x`, `y` or `z` is NaN, infinite or beyond ±1e+12"),
    ("y", 1e300, "`x`, `y` or `z` is NaN, infinite or beyond ±1e+12"),
    ("x", -1e13, "`x`, `y` or `z` is NaN, infinite or beyond ±1e+12"),  # its square would overflow
    ("nx", np.inf, "`nx`, `ny` or `nz` is NaN or infinite"),
    ("f_dc_2", -np.inf, "`f_dc_*` or `f_rest_*` is NaN or infinite"),
    ("f_rest_7", np.nan, "`f_dc_*` or `f_rest_*` is NaN or infinite"),
    ("scale_1", np.inf, "`scale_0`, `scale_1` or `scale_2` is NaN or infinite, or not a logarithm of a size"),
    ("scale_0", 100.0, "`scale_0`, `scale_1` or `scale_2` is NaN or infinite, or not a logarithm of a size"),
    ("scale_0 scale_1 scale_2", -np.inf, "`scale_0`, `scale_1` or `scale_2` is NaN or infinite, or not a logarithm"),
    ("rot_2", np.inf, "the quaternion `rot_0` to `rot_3` is zero, NaN or infinite"),
    ("rot_0 rot_1 rot_2 rot_3", 0.0, "the quaternion `rot_0` to `rot_3` is zero, NaN or infinite"),
    ("opacity", np.nan, "`opacity` is NaN"),
]


@pytest.mark.parametrize(("names", "value", "words"), BAD)
def test_what_has_no_meaning_is_left_out(tmp_path, names, value, words):
    """With a count in one warning, up to a quarter; of doubles, one of which is beyond float32."""
    columns = {name: column.astype("f8") for name, column in _columns(1, count=40).items()}
    whole = read_ply(_write(tmp_path / "a.ply", columns))
    for name in names.split():
        columns[name][[3, 9]] = value
    with user_warning(r"a\.ply: left out 2 of 40 .* for 2, first at index 3\.") as told:
        found = read_ply(_write(tmp_path / "a.ply", columns))
    assert [words in str(warning.message) for warning in told] == [True]
    _assert_equal(found, whole.select(torch.tensor([k for k in range(40) if k not in (3, 9)])))
    for name in names.split():
        columns[name][:11] = value
    refused(_write(tmp_path / "a.ply", columns), words, "11 of 40 Gaussians mean nothing", "for 11, first at index 0")


def test_flat_ones_become_a_thousandth_of_their_width(tmp_path):
    """Of a size of zero by any number; a file of 2DGS has two sizes, which is told to nobody."""
    columns = _columns(1, count=9)
    whole = read_ply(_write(tmp_path / "a.ply", columns))
    columns["scale_2"][:3] = -np.inf, -1000.0, -50.0
    with user_warning(r"a\.ply: 3 of 9 Gaussians have a size of zero, and become flat\."):
        some = read_ply(_write(tmp_path / "a.ply", columns))
    del columns["scale_2"]
    with silent():
        surfels = read_ply(_write(tmp_path / "b.ply", columns))
    thin = whole.scales[:, :2].amax(1) + np.log(1e-3)
    assert_close(some.scales[:3, 2], thin[:3])
    assert torch.equal(some.scales[3:], whole.scales[3:])
    assert_close(surfels.scales, torch.cat([whole.scales[:, :2], thin[:, None]], 1))


def _changed(**functions):
    return {name: column if name not in functions else functions[name](column) for name, column in _scene().items()}


def _scene():
    columns = {name: column.astype("f8") for name, column in _columns(count=60).items()}
    return columns | {f"scale_{k}": -4 + 0.3 * columns[f"scale_{k}"] for k in range(3)}


LOGARITHM = "`scale_0` to `scale_2` should be the logarithm of the size"
LINEAR = {f"scale_{k}": np.exp for k in range(3)}
UTM = {"x": lambda x: x + 5e5, "y": lambda y: y + 4649776.5}


@pytest.mark.parametrize(
    ("columns", "refusal", "words"),
    [
        (_changed(**{name: lambda s: s + 8 for name in LINEAR}), True, LOGARITHM),  # as large as the scene
        (_changed(**LINEAR, x=lambda x: 100 * x), False, LOGARITHM),
        (_changed(opacity=lambda logit: 1 / (1 + np.exp(-logit))), False, "`opacity` should be their logit"),
        (
            {k: v.astype("f4") for k, v in _changed(**UTM).items()},
            False,
            "steps of 0.5 in float32",
        ),
    ],
    ids=["sizes", "doubtful sizes", "opacities", "places"],
)
def test_other_units_are_named(columns, refusal, words, tmp_path):
    path = _write(tmp_path / "a.ply", columns)
    if refusal:
        refused(path, words)
    else:
        with user_warning(re.escape(words)) as told:
            assert len(read_ply(path)) == 60
        assert len(told) == 1
    with silent():
        read_ply(_write(path, _changed(**UTM)))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", b"\n<!DOCTYPE html><html>404</html>", "a web page, such as an error of a server"),
        ("a.splat", b"<?xml version='1.0'?><Error/>", "a web page"),
        ("a.spz", b"version https://git-lfs.github.com/spec/v1\noid sha256:0123\n", "run `git lfs pull`"),
        ("a.ply", b"PK\3\4" + bytes(100), "begins as a .sog file: if it is one, rename it to end in .sog"),
        ("a.splat", b"ply\nformat ascii 1.0\n" + bytes(11), "begins as a .ply file"),
        ("a.sog", b"\x1f\x8b" + bytes(9), "begins as a .spz file"),
        ("a.other", b"glTF" + bytes(9), "begins as a .glb file"),
        ("a.other", b"solid x\n", "is not a .ply file (it does not start with `ply`); export the scene as .ply"),
    ],
)
def test_a_file_of_another_kind_is_named(name, content, words, tmp_path):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, words)


def test_write_needs_gaussians_and_a_folder(tmp_path):
    with value_error(r"a\.ply was not written because the cloud holds zero Gaussians"):
        write_ply(tmp_path / "a.ply", varied_cloud(0, 3))
    with pytest.raises(FileNotFoundError, match=r"a\.ply cannot be written because .*none is not a folder; create it"):
        write_ply(tmp_path / "none" / "a.ply", varied_cloud(7, 3))


def test_cloud_selects_and_moves(device, dtype):
    cloud = varied_cloud(7, 3, normals=True).to(device, dtype)
    mask = torch.tensor([True, False, True, False, False, False, True], device=device)
    picked = cloud.select(mask)
    assert len(cloud) == 7
    assert len(picked) == 3
    for field in (*FIELDS, "normals"):
        tensor = getattr(picked, field)
        assert (tensor.dtype, tensor.device.type) == (dtype, device.type)
        assert_close(tensor, getattr(cloud, field)[[0, 2, 6]])
    assert varied_cloud(7, 3).select(torch.tensor([1])).normals is None
    with value_error("Expected `mask` of shape"):
        cloud.select(mask[:3])


def test_cloud_rejects_wrong_shape():
    cloud = varied_cloud(7, 3)
    shapes = {"means": (7, 2), "quats": (7, 3), "scales": (6, 3), "opacities": (7, 1), "sh": (7, 3), "normals": (3,)}
    for field, shape in shapes.items():
        tensors = {name: getattr(cloud, name) for name in FIELDS} | {field: torch.zeros(shape)}
        with value_error(f"`{field}`"):
            GaussianCloud(**tensors)
    with value_error("`sh` to have 1, 4, 9 or 16 coefficients, but got 5"):
        GaussianCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, torch.zeros(7, 5, 3))


# ---- headers that lie


def _header(*lines, data=b""):
    return "\n".join(("ply", "format binary_little_endian 1.0", *lines, "end_header", "")).encode() + data


def test_a_header_that_lies_is_refused_before_the_data(tmp_path):
    """A hundred bytes that announce terabytes take no memory."""
    import resource

    path = tmp_path / "bad.ply"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for words, *lines in (
        ("is truncated", "element vertex 999999999999999999", "property float x"),
        ("property `x` is a list", "element vertex 4", "property list uchar float x"),
        ("'element vertex -200'", "element vertex -200", "property float x"),
        ("a property twice", "element vertex 1", "property float x", "property float x"),
        ("no `end_header`", "comment " + "long " * 20_000),
    ):
        path.write_bytes(_header(*lines, data=b"\x01" * 20))
        refused(path, words)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # KiB


def test_only_the_element_of_the_gaussians_is_read(tmp_path):
    from gaussian_swaying.scenes.procedural import FlagScene

    cloud = FlagScene(spacing=0.3).generate()
    write_ply(tmp_path / "flag.ply", cloud)
    head, mark, body = (tmp_path / "flag.ply").read_bytes().partition(b"end_header\n")
    head = head.replace(b"element vertex", b"element camera 2\nproperty double fx\nelement vertex")
    head += b"element face 1\nproperty list uchar int vertex_indices\n"
    (tmp_path / "more.ply").write_bytes(head + mark + bytes(16) + body + b"\x01\0\0\0\0")
    again = read_ply(tmp_path / "more.ply")
    assert torch.equal(again.means, cloud.means)
    assert torch.equal(again.opacities, cloud.opacities)


def test_a_file_that_is_longer_than_its_header_says_is_warned_of(tmp_path):
    write_ply(tmp_path / "flag.ply", varied_cloud(7, 3))
    with (tmp_path / "flag.ply").open("ab") as file:
        file.write(bytes(28))
    with user_warning("28 bytes follow that its header does not mention"):
        assert len(read_ply(tmp_path / "flag.ply")) == 7
    for line, other in ((b"vertex 7", b"vertex 5"), (b"property float rot_3\n", b"")):
        write_ply(tmp_path / "a.ply", varied_cloud(700 if other == b"" else 7, 3))
        content = (tmp_path / "a.ply").read_bytes()
        (tmp_path / "a.ply").write_bytes(content.replace(line, other, 1))
        refused(tmp_path / "a.ply", "bytes follow the rows that `element` and `property` of its header announce")
