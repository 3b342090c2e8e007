import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import append_fields, drop_fields
from other_writers import refused
from plyfile import PlyData, PlyElement
from shared import near, user_warning
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians
from gaussian_swaying.gaussians.harmonics import SH_DC


def test_flat_ones_of_other_programs(tmp_path):
    path = tmp_path / "flat.ply"
    _compressed(path, lambda elements: elements["chunk"]["min_scale_z"].put(0, -np.inf))
    with user_warning(r"of 300 Gaussians have a size of zero, and become flat"):
        cloud = read_gaussians(path)
    assert len(cloud) == 300
    assert cloud.scales.isfinite().all()


def test_logarithms_in_place_of_sizes(tmp_path):
    export_cloud(tmp_path / "a.splat", varied_cloud(20, degree=0))
    rows = np.fromfile(tmp_path / "a.splat", np.dtype([("means", "<f4", 3), ("sizes", "<f4", 3), ("rest", "u1", 8)]))
    rows["sizes"] = np.log(rows["sizes"])
    rows.tofile(tmp_path / "a.splat")
    refused(tmp_path / "a.splat", "the size is negative (store the size itself, not its logarithm) for 20, first")


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
    assert_close(cloud.sh[0, 0] * SH_DC + 0.5, torch.tensor([255.0, 128.0, 64.0]) / 255)
    near(cloud.quats[0], torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0]), 2e-3)


def _compressed(path, change):
    export_cloud(path, varied_cloud(degree=1), format="compressed_ply")
    ply = PlyData.read(str(path))
    elements = {element.name: element.data.copy() for element in ply.elements}
    change(elements)
    PlyData([PlyElement.describe(data, name) for name, data in elements.items()], byte_order="<").write(str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.update(chunk=e["chunk"][:1]), "has 1 chunks, which are not those of 300 Gaussians"),
        (lambda e: e.update(chunk=e["chunk"][[0, 1, 1]]), "has 3 chunks, which are not those of 300 Gaussians"),
        (lambda e: e.update(vertex=drop_fields(e["vertex"], "packed_scale")), "no property `packed_scale`"),
        (lambda e: e.update(chunk=drop_fields(e["chunk"], "max_y")), "no property `max_y` in its chunks"),
        (lambda e: e.update(sh=e["sh"][:7]), "the element `sh` does not hold 9, 24 or 45"),
        (
            lambda e: e["chunk"]["min_x"].fill(np.nan),
            "NaN, infinite or beyond ±1e+12 for 300, first",
        ),
        (lambda e: e["chunk"]["min_x"].fill(-9e37), "beyond ±1e+12 for"),
        (lambda e: e["chunk"]["max_scale_z"].fill(1e5), "`scale_2` is NaN or infinite"),
        (
            lambda e: e.update(vertex=append_fields(e["vertex"], "f_rest_0", np.zeros(300))),
            "has the properties f_rest_0",
        ),
        (lambda e: e.update(vertex=e["vertex"][:0]), "zero Gaussians"),
    ],
)
def test_bad_compressed_ply(change, message, tmp_path):
    path = tmp_path / "bad.compressed.ply"
    _compressed(path, change)
    refused(path, message)
