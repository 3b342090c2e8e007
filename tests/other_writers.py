"""One small scene in files that another program wrote, how far two clouds may differ, and how a file is refused."""

import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.harmonics import rotate_sh
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

FILES = Path(__file__).parent / "gaussians" / "files"


def scene():
    return read_ply(FILES / "scene.ply")


def turned(cloud, rotation):
    """The cloud after a rotation (3, 3) about the origin."""
    return replace(
        cloud,
        means=cloud.means @ rotation.T,
        quats=rotation_to_quat(rotation @ quat_to_rotation(cloud.quats)),
        sh=rotate_sh(cloud.sh, rotation),
    )


def angle(a, b):
    """Largest angle between the axes of two clouds [radians]; half a turn about an axis changes no Gaussian."""
    a, b = (quat_to_rotation(cloud.quats.double()) for cloud in (a, b))
    return float(2 * rotation_to_quat(a.mT @ b).abs().amax(-1).clamp(max=1).acos().max())


def assert_same(found, expected, *, means, scales, opacities, colors, sh, quats):
    """Each field within a tolerance: opacities from 0 to 1, harmonics of degree 0 and above, an angle."""
    assert found.sh.shape == expected.sh.shape
    for name, a, b, atol in (
        ("means", found.means, expected.means, means),
        ("scales", found.scales, expected.scales, scales),
        ("opacities", found.opacities.sigmoid(), expected.opacities.sigmoid(), opacities),
        ("colors", found.sh[:, :1], expected.sh[:, :1], colors),
        ("sh", found.sh[:, 1:], expected.sh[:, 1:], sh),
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=atol, msg=lambda text, name=name: f"{name}: {text}")
    assert angle(found, expected) < quats


def in_order(found, expected):
    """The found Gaussians in the order of the expected ones, as some formats sort."""
    order = torch.cdist(expected.means.double(), found.means.double()).argmin(1)
    assert order.unique().numel() == len(expected) == len(found)
    return found.select(order)


def glb_parts(content):
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def glb(document, data):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data)) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def refused(path, *words, name=None):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        read_gaussians(path)
    told = str(caught.value)
    assert "\n" not in told
    for word in (name or str(path), *words):
        assert word in told
