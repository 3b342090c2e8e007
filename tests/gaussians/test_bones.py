"""Bones that are fitted to a motion, and the skin in a glTF file, decoded here by the rules of glTF alone."""

import json
import struct
import subprocess
import sys

import numpy as np
import pytest
import torch
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians.bones import fit_bones
from gaussian_swaying.gaussians.gltf import encode_skinned_gltf, read_gltf
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.rotations import quat_to_rotation


def bent(rest, angle):
    """A strip along x that is rolled up around y, by an angle over its length of 1."""
    if not angle:
        return rest
    turn, radius = rest[:, 0] * angle, 1 / angle + rest[:, 2]
    return torch.stack([radius * turn.sin(), rest[:, 1], radius * turn.cos() - 1 / angle], -1)


def test_rigid_parts_are_exact_and_what_is_still_stays():
    rest = torch.rand(600, 3, dtype=torch.float64)
    part = (rest[:, 0] * 3).long().clamp(max=2)
    frames = []
    for k in range(8):
        turn = quat_to_rotation(torch.tensor([1.0, 0.1 * k, 0.05 * k, 0.0], dtype=torch.float64))
        moved = torch.stack([rest, rest @ turn.T + 0.1 * k, rest @ turn - 0.05 * k])
        frames.append(moved[part, torch.arange(600)])
    frames = torch.stack(frames)
    bones = fit_bones(rest, frames, 8)
    assert bones.error(rest, frames) < 1e-3
    assert_close(bones.places(rest, 7)[part == 0], rest[part == 0], rtol=0, atol=1e-3)
    assert bones.weight.min() >= 0
    assert_close(bones.weight.sum(1), torch.ones(600, dtype=torch.float64))


def test_more_bones_miss_less_of_a_strip_that_rolls():
    rest = torch.rand(800, 3, dtype=torch.float64) * torch.tensor([1.0, 0.3, 0.01])
    frames = torch.stack([bent(rest, 0.25 * k) for k in range(10)])
    few, many = (fit_bones(rest, frames, count).error(rest, frames) for count in (4, 12))
    assert many < 0.5 * few
    assert many < 0.02
    still = frames[:1].expand(10, -1, -1)
    assert_close(fit_bones(rest, still, 4).places(rest, 9), rest)


def decoded(data):
    """The document of a .glb file, and a reader of its accessors."""
    length = struct.unpack_from("<I", data, 12)[0]
    root = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]

    def read(index):
        accessor = root["accessors"][index]
        view = root["bufferViews"][accessor["bufferView"]]
        kind = {5120: "i1", 5121: "u1", 5122: "<i2", 5126: "<f4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        size = np.dtype(kind).itemsize
        assert view.get("byteStride", width * size) % 4 == 0
        strides = view.get("byteStride", width * size), size
        rows = np.ndarray((accessor["count"], width), kind, binary, view["byteOffset"], strides)
        top = np.iinfo(kind).max if accessor.get("normalized") else 1
        return torch.from_numpy(rows.astype(np.float64) / top)

    return root, read


def posed(root, read, frame):
    """Where a skin has the vertices of the first mesh in a frame of its animation."""
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    place, joint, weight = (read(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
    assert_close(weight.sum(1), torch.ones(len(weight), dtype=torch.float64))
    inverse = read(root["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).mT
    base = torch.tensor(root["nodes"][1].get("translation", [0.0] * 3), dtype=torch.float64)
    (animation,) = root["animations"]
    local = torch.eye(4, dtype=torch.float64).repeat(len(inverse), 1, 1)
    for number, node in enumerate(root["skins"][0]["joints"]):
        local[number, :3, 3] = torch.tensor(root["nodes"][node]["translation"])
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert float(read(sampler["input"])[frame]) == pytest.approx(frame / 25)
        value, number = read(sampler["output"])[frame], channel["target"]["node"] - 2
        if channel["target"]["path"] == "rotation":
            local[number, :3, :3] = quat_to_rotation(value[[3, 0, 1, 2]])
        else:
            local[number, :3, 3] = value
    matrix = (weight[..., None, None] * (local @ inverse)[joint.long()]).sum(1)
    return (matrix[:, :3, :3] @ place[..., None])[..., 0] + matrix[:, :3, 3] + base


TURN = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
SCALE = 2.0
STEP = 1.5 * 2 / 32767 + 3 / 255 * 0.6  # of positions, and of weights on what bones differ by


def made(origin):
    """A strip that rolls up but for its last hundred Gaussians, its bones, and what takes its places to a file's."""
    rest = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([1.0, 0.3, 0.01])
    bones = fit_bones(rest, torch.stack([bent(rest, 0.3 * k) for k in range(6)]), 6)
    bones.index[400:], bones.weight[400:] = 0, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    cloud = varied_cloud(500, 1)
    cloud.means.copy_(rest)
    cloud = type(cloud)(cloud.means, cloud.quats, cloud.scales - 2, cloud.opacities, cloud.sh, origin=origin)

    def taken(places):
        turned = (places + torch.tensor(origin, dtype=torch.float64)) @ TURN.T * SCALE
        return turned[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])

    return cloud, bones, rest, taken


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (1000.0, -2000.0, 30.0)])
def test_a_skin_moves_as_the_bones_do(tmp_path, origin):
    cloud, bones, rest, taken = made(origin)
    data = encode_skinned_gltf(cloud, bones, 25.0, TURN, SCALE)
    root, read = decoded(data)
    for frame in (0, 5):
        assert_close(posed(root, read, frame), taken(bones.places(rest, frame))[:400], rtol=0, atol=STEP)
    (primitive,) = root["meshes"][1]["primitives"]  # what does not move needs no weights
    assert "JOINTS_0" not in primitive["attributes"]
    assert len(read(primitive["attributes"]["POSITION"])) == 100
    assert "skin" not in root["nodes"][root["scenes"][0]["nodes"][-1]]
    (tmp_path / "skin.glb").write_bytes(data)
    still = read_gltf(tmp_path / "skin.glb")  # what does not know skins takes the node
    assert_close(still.means.double() + torch.tensor(still.origin), taken(rest), rtol=0, atol=1e-4)
    assert_close(still.scales.exp(), 2 * cloud.scales.exp(), rtol=0.01, atol=1e-4)


def middles(corners):
    """Those of rectangles of two triangles, shape (M, 3)."""
    return 0.5 * (corners[0::6] + corners[2::6])


def test_a_mesh_in_the_place_of_gaussians_moves_as_they_do(monkeypatch):
    cloud, bones, rest, taken = made((0.0, 0.0, 0.0))
    root, read = decoded(encode_skinned_gltf(cloud, bones, 25.0, TURN, SCALE, proxy=True))
    assert root["extensionsUsed"] == ["KHR_materials_unlit"]  # and none is required
    (primitive,) = root["meshes"][0]["primitives"]
    corners = read(primitive["attributes"]["POSITION"])
    distance, index = nearest_neighbours(taken(rest), 1, middles(corners))
    assert distance.max() < 1e-6
    assert len(index.unique()) == len(index)
    for frame in (0, 5):
        wanted = taken(bones.places(rest, frame))[index[:, 0]]
        assert_close(middles(posed(root, read, frame)), wanted, rtol=0, atol=STEP)
    covered = nearest_neighbours(middles(corners), 1, taken(rest))[0]
    side = (corners[1::6] - corners[0::6]).norm(dim=1).median()
    assert covered.max() < 2 * side  # there is a rectangle beside each Gaussian
    monkeypatch.setattr("gaussian_swaying.gaussians.gltf._RECTANGLES", 50)
    root, read = decoded(encode_skinned_gltf(cloud, bones, 25.0, TURN, SCALE, proxy=True))
    fewer = read(root["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    assert 20 * 6 < len(fewer) <= 50 * 6


IN_BLENDER = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 25
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
found = []
mesh = max((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: len(o.data.vertices))
for frame in (0, 5):
    bpy.context.scene.frame_set(frame)
    now = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found.append([list(now.matrix_world @ vertex.co) for vertex in now.data.vertices])
print(json.dumps(found))
"""


def test_blender_moves_the_mesh(tmp_path):
    pytest.importorskip("bpy")
    cloud, bones, _, _ = made((0.0, 0.0, 0.0))
    data = encode_skinned_gltf(cloud, bones, 25.0, TURN, SCALE, proxy=True)
    (tmp_path / "mesh.glb").write_bytes(data)
    command = [sys.executable, "-c", IN_BLENDER, str(tmp_path / "mesh.glb")]
    said = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
    for frame, places in zip((0, 5), said, strict=True):
        upright = torch.tensor(places, dtype=torch.float64)[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])
        assert_close(upright, posed(*decoded(data), frame), rtol=0, atol=1e-5)
