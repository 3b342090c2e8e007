import base64
import json
import math
import struct
import tracemalloc

import numpy as np
import pytest
import torch
from other_writers import FILES, assert_same, glb, glb_parts, refused, scene, turned
from shared import near, peak, user_warning, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians
from gaussian_swaying.gaussians.gltf import encode_gltf, read_gltf
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.rotations import rotation_from_z

CLOSE = {"means": 2e-6, "scales": 1e-5, "opacities": 1e-6, "colors": 1e-6, "sh": 1e-5, "quats": 1e-5}  # of float32
Y_TO_Z = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
KHR = "KHR_gaussian_splatting"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(degree, tmp_path):
    cloud = varied_cloud(degree=degree)
    up = torch.tensor([0.3, -0.9, 0.2])
    turn = rotation_from_z(up).T
    export_cloud(tmp_path / "a.glb", cloud, metres_per_unit=0.5, rotation=turn)
    found = read_gaussians(tmp_path / "a.glb")
    upright = turned(found, turn.T.float() @ Y_TO_Z)
    back = upright.means * 2, upright.scales + math.log(2)
    assert_same(type(found)(back[0], upright.quats, back[1], upright.opacities, upright.sh), cloud, **CLOSE)
    heights = cloud.means @ torch.nn.functional.normalize(up, dim=0)
    near(found.means[:, 1], 0.5 * heights, 2e-6)
    export_cloud(tmp_path / "b.glb", cloud)  # z is up
    assert_close(read_gaussians(tmp_path / "b.glb").means[:, 1], cloud.means[:, 2])


def test_as_splat_transform_writes_it():
    """It turns a .ply, whose y points down, by half a turn about z."""
    found = read_gltf(FILES / "scene.glb")
    assert_same(turned(found, torch.diag(torch.tensor([-1.0, -1.0, 1.0]))), scene(), **CLOSE)


def _written(path, document, data):
    path.write_bytes(glb(document, data))
    return path


def test_the_file_is_as_the_standard_wants_it():
    cloud = varied_cloud(7, degree=1)
    content = encode_gltf(cloud)
    document, data = glb_parts(content)
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content))
    assert len(content) % 4 == 0
    assert document["buffers"] == [{"byteLength": len(data)}]
    assert document["extensionsUsed"] == [KHR]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR]["kernel"] == "ellipse"
    places = {name: document["bufferViews"][index] for name, index in primitive["attributes"].items()}
    assert [accessor["bufferView"] for accessor in document["accessors"]] == list(range(len(places)))
    assert all(view["byteOffset"] % 4 == 0 for view in places.values())

    def column(name, dtype, width):
        view = places[name]
        return np.frombuffer(data[view["byteOffset"] :][: view["byteLength"]], dtype).reshape(7, width)

    centres = column("POSITION", "<f4", 3)
    assert document["accessors"][0]["min"] == centres.min(0).tolist()
    assert document["accessors"][0]["max"] == centres.max(0).tolist()
    np.testing.assert_allclose(np.linalg.norm(column(f"{KHR}:ROTATION", "<f4", 4), axis=1), 1, atol=1e-6)
    shown = np.clip(cloud.sh[:, 0].numpy() * SH_DC + 0.5, 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(column("COLOR_0", "u1", 4)[:, :3] / 255, linear, atol=0.501 / 255)


def test_nodes_move_what_they_hold(tmp_path):
    cloud = varied_cloud(5, degree=2)
    document, data = glb_parts(encode_gltf(cloud, rotation=Y_TO_Z))  # y is up already
    quarter = [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)]  # about y: z to x
    document["nodes"] = [
        {"children": [1], "rotation": quarter, "translation": [0, 0, 7]},
        {"mesh": 0, "scale": [2, 2, 2], "translation": [1, 0, 0]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 3, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
    ]
    document["scenes"] = [{"nodes": []}, {"nodes": [0, 2]}]
    document["scene"] = 1
    found = read_gaussians(_written(tmp_path / "a.glb", document, data))
    assert len(found) == 10
    first, second = (found.select(torch.arange(5) + k) for k in (0, 5))
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    expected = turned(cloud, turn)
    shift = torch.tensor([0.0, 0.0, 6.0])  # 7, and the shift of the inner node by 1 along x, which is -z now
    expected = type(cloud)(
        2 * expected.means + shift, expected.quats, expected.scales + math.log(2), expected.opacities, expected.sh
    )
    assert_same(first, expected, **CLOSE | {"means": 1e-5})
    stretch = torch.diag(torch.tensor([1.0, 3.0, 1.0]))
    near(second.means, cloud.means @ stretch + torch.tensor([5.0, 0, 0]), 1e-5)
    wide = stretch @ covariance(cloud.quats, cloud.scales) @ stretch
    assert_close(covariance(second.quats, second.scales), wide, rtol=1e-4, atol=1e-6)
    near(second.sh, cloud.sh, 1e-5)
    del document["scenes"], document["scene"]  # then all nodes that are nobody's children
    assert len(read_gaussians(_written(tmp_path / "b.glb", document, data))) == 10


def test_numbers_of_every_kind(tmp_path):
    rows = np.zeros(3, dtype=[("p", "<f4", 3), ("q", "<i2", 4), ("s", "u1", 3), ("o", "u1"), ("c", "<f4", 3)])
    rows["p"], rows["q"][:, 3], rows["s"], rows["c"] = np.eye(3), 32767, [255, 51, 0], 0.25
    rows["q"][1] = [-32768, 0, 0, 32767]
    rows["o"] = [0, 51, 255]
    accessors = [
        {"bufferView": 0, "byteOffset": rows.dtype.fields[name][1], "componentType": kind, "count": 3, "type": width}
        | ({"normalized": True} if kind != 5126 else {})
        for name, kind, width in (
            ("p", 5126, "VEC3"), ("q", 5122, "VEC4"), ("s", 5121, "VEC3"), ("o", 5121, "SCALAR"), ("c", 5126, "VEC3")
        )
    ]  # fmt: skip
    names = ["POSITION", *(f"{KHR}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))]
    attributes = {name: index for index, name in enumerate(names)}
    higher = attributes | {f"{KHR}:SH_DEGREE_1_COEF_{k}": 4 for k in range(3)}
    kind = {"mode": 0, "extensions": {KHR: {"kernel": "ellipse", "colorSpace": "lin_rec709_display"}}}
    document = {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {}}, *({"attributes": a} | kind for a in (attributes, higher))]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}],
        "buffers": [{"byteLength": rows.nbytes, "uri": "my%20data.bin"}],
    }
    (tmp_path / "my data.bin").write_bytes(rows.tobytes())
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(rows.tobytes()).decode()
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    for name in ("a.gltf", "b.gltf"):
        with user_warning("colours in linear light"):
            cloud = read_gaussians(tmp_path / name)
        assert cloud.sh.shape == (6, 4, 3)
        assert peak(cloud.sh[:3, 1:]) == 0
        assert (cloud.sh[3:] == 0.25).all()
        assert torch.equal(cloud.means[:3], torch.eye(3))
        assert_close(cloud.quats[1], torch.tensor([1.0, -1.0, 0.0, 0.0]))
        assert_close(cloud.scales[0], torch.tensor([0.0, math.log(0.2), math.log(1e-3)]))
        assert_close(cloud.opacities[:3].sigmoid(), torch.tensor([0.5 / 255, 0.2, 1 - 0.5 / 255]))


def _changed(change):
    document, data = glb_parts(encode_gltf(varied_cloud(2, degree=1)))
    change(document, document["meshes"][0]["primitives"][0])
    return document, data


def _set(place, **values):
    """Sets entries of a part of the document, such as `accessors 0`."""

    def change(document, primitive):
        part = document
        for word in place.split():
            part = part[int(word) if word.isdigit() else word]
        part.update(values)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d, p: p.pop("extensions"), "no primitive with `KHR_gaussian_splatting`"),
        (lambda d, p: p["extensions"][KHR].update(extensions={"KHR_spz": {}}), "by the extensions ['KHR_spz']"),
        (lambda d, p: p["attributes"].pop("POSITION"), "it has no `POSITION`"),
        (lambda d, p: p["attributes"].pop(f"{KHR}:SH_DEGREE_1_COEF_2"), "SH_DEGREE_1_COEF_2`"),
        (_set("nodes 0", children=[0]), "node 0 is there twice"),
        (_set("nodes 0", scale=[1, 0, 1]), "singular or infinite"),
        (_set("nodes 0", scale=[1, -1, 1]), "shears or mirrors its Gaussians"),
        (_set("nodes 0", matrix=[1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "shears or mirrors"),
        (_set("nodes 0", scale=[1e20] * 3), "beyond ±1e+12"),
        (_set("accessors 0", count=2**31), "announces a `count` of 2,147,483,648 Gaussians, far more"),
        (lambda d, p: d.update(extensionsRequired=[KHR, "EXT_meshopt"]), "requires the extensions ['EXT_meshopt']"),
        (lambda d, p: p.update(mode=4), "`mode` 4 of Gaussians is not 0"),
        (lambda d, p: p.pop("mode"), "`mode` 4 of Gaussians is not 0"),
        (lambda d, p: p.update(indices=0), "or they have `indices`"),
        (_set("accessors 0", componentType=5125), "it has no `5125`"),
        (_set("accessors 0", type="VEC4"), "accessor 0 is sparse or not of 3 numbers"),
        (_set("bufferViews 0", byteLength=20), "is not a usable glTF file"),
        (_set("accessors 0", sparse={}), "accessor 0 is sparse"),
        (_set("bufferViews 0", byteStride=2**70), "is not a usable glTF file"),
        (lambda d, p: d.update(accessors=[dict(a, count=0) for a in d["accessors"]]), "zero Gaussians"),
    ],
)
def test_bad_documents(change, message, tmp_path):
    refused(_written(tmp_path / "bad.glb", *_changed(change)), message)


@pytest.mark.parametrize("name", ["bad.glb", "bad.gltf"])
def test_bad_files(name, tmp_path):
    good = encode_gltf(varied_cloud(2, degree=0))
    for content, message in (
        (b"[]", "is not a usable glTF file"),
        (b'{"scene": ' + b"9" * 50 + b"}", "a whole number of 50 digits"),
        (good[:100], "`version` 2 with a `length` of"),
        (good + b"more", "`version` 2 with a `length` of"),
        (good[:12] + b"\xff\xff\xff\xff" + good[16:], "a part of 4,294,967,295 bytes is announced"),
        (struct.pack("<4sII", b"glTF", 2, 20) + struct.pack("<I4s", 0, b"JSON"), "is not valid JSON"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, message)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("../secret.bin", "takes its data from '../secret.bin'; put that file beside it"),
        ("%2e%2e/secret.bin", "takes its data from '../secret.bin'"),
        ("/etc/hosts", "takes its data from '/etc/hosts'"),
        ("https://example.org/a.bin", "takes its data from 'https://example.org/a.bin'"),
        ("data:;base64,%%", "is not a usable glTF file"),
        ("data:;base64,AAAA", "is not a usable glTF file"),
        (None, "is not a usable glTF file"),
        ("none.bin", "none.bin does not exist"),
    ],
)
def test_data_elsewhere(uri, message, tmp_path):
    (tmp_path / "secret.bin").write_bytes(bytes(1000))
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "bad.gltf"
    path.write_text(json.dumps(_changed(_set("buffers 0", uri=uri))[0]))
    refused(path, message, name=str(path.parent))


def test_one_mesh_many_times(tmp_path):
    document, data = _changed(lambda d, p: None)
    document["nodes"] = [{"mesh": 0}] * 20
    document["scenes"] = [{"nodes": list(range(20))}]
    assert len(read_gaussians(_written(tmp_path / "a.glb", document, data))) == 40
    count = 1_000_000
    wide = {"bufferView": 0, "componentType": 5121, "count": count, "normalized": True}
    document["accessors"] = [wide | {"type": a["type"]} for a in document["accessors"]]
    document["bufferViews"] = [{"buffer": 0, "byteLength": 4 * count}]
    tracemalloc.start()
    refused(
        _written(tmp_path / "b.glb", document, bytes(4 * count)),
        "announces a `count` of 20,000,000 Gaussians, far more",
    )
    assert tracemalloc.get_traced_memory()[1] < 1 << 25
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("POSITION", math.nan, "`x`, `y` or `z` is NaN, infinite or beyond ±1e+12 for 1, first"),
        (f"{KHR}:SCALE", -3.0, "attribute `SCALE` is negative (store the size itself, not its logarithm) for 1, first"),
        (f"{KHR}:OPACITY", 4.0, "attribute `OPACITY` is not from 0 to 1 (store the opacity itself, not its logit)"),
    ],
)
def test_bad_numbers(name, value, message, tmp_path):
    document, data = _changed(lambda d, p: None)
    place = document["meshes"][0]["primitives"][0]["attributes"][name]
    data = bytearray(data)
    struct.pack_into("<f", data, document["bufferViews"][place]["byteOffset"], value)
    refused(_written(tmp_path / "bad.glb", document, bytes(data)), message)


def test_too_large_for_the_format(tmp_path, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.gaussians.gltf.LARGEST", 100)
    with value_error(r"A \.glb file holds less than 4 GB, but this one would take"):
        export_cloud(tmp_path / "a.glb", varied_cloud(2))
    assert not list(tmp_path.iterdir())
