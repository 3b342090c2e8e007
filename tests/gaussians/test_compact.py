"""Splats in the formats of web viewers, read again."""

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from small_scenes import varied_cloud

from gaussian_swaying.gaussians.compact import read_compressed_ply, read_splat
from gaussian_swaying.gaussians.export import export_cloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.simulation.scene import Scene


def _in_order(found, expected):
    """The found Gaussians in the order of the expected ones, as the formats sort."""
    order = torch.cdist(expected.means, found.means).argmin(1)
    assert order.unique().numel() == len(expected) == len(found)
    return found.select(order)


def _turned(a, b):
    """Angle between rotations [radians]; q and -q are the same."""
    a, b = (torch.nn.functional.normalize(q.double(), dim=-1) for q in (a, b))
    return 2 * (a * b).sum(-1).abs().clamp(max=1).acos()


def test_splat(tmp_path):
    """Centres and sizes exactly; colours, opacities and quaternions to the 8 bits that are cut off, not rounded."""
    cloud = varied_cloud(degree=0)
    export_cloud(tmp_path / "a.splat", cloud, format="splat")
    found = _in_order(read_splat(tmp_path / "a.splat"), cloud)
    assert torch.equal(found.means, cloud.means)
    torch.testing.assert_close(found.scales, cloud.scales)
    step = 1.01 / 255
    torch.testing.assert_close(found.sh * SH_DC, cloud.sh * SH_DC, rtol=0, atol=step)
    torch.testing.assert_close(found.opacities.sigmoid(), cloud.opacities.sigmoid(), rtol=0, atol=step)
    # each of four components is off by at most 1 / 128
    assert float(_turned(found.quats, cloud.quats).max()) < 2 * 2 * 1.01 / 128
    assert found.normals is None


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compressed_ply(degree, tmp_path):
    """Within a step of each chunk's range, harmonics of every degree in their place; what is faint is gone."""
    faint = varied_cloud(degree=degree)
    faint.opacities[7] = -8.0
    export_cloud(tmp_path / "a.compressed.ply", faint, format="compressed_ply")
    elements = [element.name for element in PlyData.read(str(tmp_path / "a.compressed.ply")).elements]
    assert elements == (["chunk", "vertex", "sh"] if degree else ["chunk", "vertex"])
    cloud = faint.select(torch.arange(300) != 7)
    found = _in_order(read_compressed_ply(tmp_path / "a.compressed.ply"), cloud)
    assert found.sh.shape == cloud.sh.shape
    torch.testing.assert_close(found.means, cloud.means, rtol=0, atol=4 / 1023)
    torch.testing.assert_close(found.scales, cloud.scales, rtol=0, atol=2 / 1023)
    torch.testing.assert_close(found.sh[:, 0] * SH_DC, cloud.sh[:, 0] * SH_DC, rtol=0, atol=1 / 255)
    torch.testing.assert_close(found.sh[:, 1:], cloud.sh[:, 1:], rtol=0, atol=8 / 256)
    torch.testing.assert_close(found.opacities.sigmoid(), cloud.opacities.sigmoid(), rtol=0, atol=1 / 255)
    # three components within half a step of sqrt(2) / 1023; the fourth, at least 1/2, follows from them
    assert float(_turned(found.quats, cloud.quats).max()) < 4 * 2**0.5 / 1023


def test_any_format_by_name_and_content(tmp_path):
    """What a scene takes: a compressed file is known by its header, whatever its name."""
    cloud = varied_cloud(degree=0)
    write_ply(tmp_path / "a.ply", cloud)
    export_cloud(tmp_path / "b.compressed.ply", cloud, format="compressed_ply")
    (tmp_path / "b.compressed.ply").rename(tmp_path / "b.ply")
    export_cloud(tmp_path / "c.splat", cloud, format="splat")
    for name in ("a.ply", "b.ply", "c.splat"):
        assert len(Scene(ply=tmp_path / name).cloud()) == len(cloud)
    assert torch.equal(read_gaussians(tmp_path / "a.ply").means, cloud.means)


def test_files_of_other_programs(tmp_path):
    """Opacity bytes of 0 and 255 stay finite; older files have no range of colours."""
    names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    rows = np.zeros(2, dtype=[(name, "u4") for name in names])
    rows["packed_color"] = [0xFF804000, 0xFF8040FF]
    rows["packed_rotation"] = (1 << 30) | (1023 << 20) | (511 << 10) | 512  # x is the largest, w one over sqrt(2)
    ends = [f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    chunk = np.zeros(1, dtype=[(name, "f4") for name in ends])
    chunk["max_x"] = 1.0
    path = tmp_path / "old.ply"
    PlyData([PlyElement.describe(chunk, "chunk"), PlyElement.describe(rows, "vertex")]).write(str(path))
    cloud = read_gaussians(path)
    assert torch.isfinite(cloud.opacities).all()
    assert cloud.opacities[0] < -6
    assert cloud.opacities[1] > 6
    torch.testing.assert_close(cloud.sh[0, 0] * SH_DC + 0.5, torch.tensor([255.0, 128.0, 64.0]) / 255)
    torch.testing.assert_close(cloud.quats[0], torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0]), rtol=0, atol=2e-3)


def _compressed(path, change):
    export_cloud(path, varied_cloud(degree=1), format="compressed_ply")
    ply = PlyData.read(str(path))
    elements = {element.name: element.data.copy() for element in ply.elements}
    change(elements)
    PlyData([PlyElement.describe(data, name) for name, data in elements.items()], byte_order="<").write(str(path))


def _without(table, name):
    kept = [field for field in table.dtype.names if field != name]
    out = np.empty(len(table), dtype=[(field, table.dtype[field]) for field in kept])
    for field in kept:
        out[field] = table[field]
    return out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.update(chunk=e["chunk"][:1]), "has 1 chunks, too few for 300 Gaussians in chunks of 256"),
        (lambda e: e.update(vertex=_without(e["vertex"], "packed_scale")), "no property `packed_scale`"),
        (lambda e: e.update(chunk=_without(e["chunk"], "max_y")), "no property `max_y` in its chunks"),
        (lambda e: e.update(sh=e["sh"][:7]), "the element `sh` does not hold 9, 24 or 45"),
        (lambda e: e["chunk"]["min_x"].fill(np.nan), "`means` is NaN or infinite for 300 of 300 Gaussians"),
        (lambda e: e["chunk"]["min_x"].fill(-9e37), "beyond ±1e+12 for"),
        (lambda e: e["chunk"]["max_scale_z"].fill(1e5), "gives a size of zero or infinity"),
        (lambda e: e.update(vertex=e["vertex"][:0]), "zero Gaussians"),
    ],
)
def test_bad_compressed_ply(change, message, tmp_path):
    path = tmp_path / "bad.compressed.ply"
    _compressed(path, change)
    with pytest.raises(ValueError, match=r"bad\.compressed\.ply") as caught:
        read_gaussians(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
