"""Bones that are fitted to a motion, and the skin in a glTF file, decoded here by the rules of glTF alone."""

import json
import struct

import numpy as np
import pytest
import torch
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians.bones import fit_bones
from gaussian_swaying.gaussians.gltf import encode_skinned_gltf, read_gltf
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


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (1000.0, -2000.0, 30.0)])
def test_a_skin_moves_as_the_bones_do(tmp_path, origin):
    rest = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([1.0, 0.3, 0.01])
    frames = torch.stack([bent(rest, 0.3 * k) for k in range(6)])
    bones = fit_bones(rest, frames, 6)
    cloud = varied_cloud(500, 1)
    cloud.means.copy_(rest)
    cloud = type(cloud)(cloud.means, cloud.quats, cloud.scales - 2, cloud.opacities, cloud.sh, origin=origin)
    turn = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    data = encode_skinned_gltf(cloud, bones, 25.0, turn, 2.0)
    root, read = decoded(data)
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    place, joint, weight = (read(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
    assert_close(weight.sum(1), torch.ones(500, dtype=torch.float64))
    inverse = read(root["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).mT
    base = torch.tensor(root["nodes"][1].get("translation", [0.0] * 3), dtype=torch.float64)
    (animation,) = root["animations"]
    step = 1.5 * 2 / 32767 + 3 / 255 * 0.6  # of positions, and of weights on what bones differ by
    for frame in (0, 5):
        local = torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            assert float(read(sampler["input"])[frame]) == pytest.approx(frame / 25)
            value, number = read(sampler["output"])[frame], channel["target"]["node"] - 2
            if channel["target"]["path"] == "rotation":
                local[number, :3, :3] = quat_to_rotation(value[[3, 0, 1, 2]])
            else:
                local[number, :3, 3] = value
        matrix = (weight[..., None, None] * (local @ inverse)[joint.long()]).sum(1)
        found = (matrix[:, :3, :3] @ place[..., None])[..., 0] + matrix[:, :3, 3] + base
        wanted = (bones.places(rest, frame) + torch.tensor(origin, dtype=torch.float64)) @ turn.T * 2.0
        assert_close(found, wanted[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0]), rtol=0, atol=step)
    (tmp_path / "skin.glb").write_bytes(data)
    still = read_gltf(tmp_path / "skin.glb")  # what does not know skins takes the node
    wanted = (rest + torch.tensor(origin, dtype=torch.float64)) @ turn.T * 2.0
    wanted = wanted[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])
    assert_close(still.means.double() + torch.tensor(still.origin), wanted, rtol=0, atol=1e-4)
    assert_close(still.scales.exp(), 2 * cloud.scales.exp(), rtol=0.01, atol=1e-4)
