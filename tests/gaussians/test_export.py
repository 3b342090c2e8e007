import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from shared import near, silent, user_warning, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close
from usd_files import read_usd_frame

from gaussian_swaying.gaussians.formats import (
    FORMATS,
    cleaned,
    export_cloud,
    export_frames,
    format_of,
    read_gaussians,
)
from gaussian_swaying.gaussians.usd import usd_arrays, write_usd
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat


def test_one_bad_value_does_not_empty_the_file(tmp_path):
    cloud = varied_cloud()
    cloud.opacities[3], cloud.opacities[4], cloud.opacities[5] = math.nan, math.inf, -math.inf
    cloud.means[6, 1], cloud.sh[7, 1, 0], cloud.quats[8] = math.inf, math.nan, 0.0
    cloud.scales[9, 0], cloud.scales[10, 0] = math.nan, -math.inf
    gone = [3, 6, 7, 8, 9]
    kept = torch.tensor([k for k in range(300) if k not in gone])
    for format in ("splat", "compressed_ply", "ply"):
        path = tmp_path / f"a{FORMATS[format].endings[0]}"
        with user_warning(r"left out 5 of 300 Gaussians: .*; 1 of 300 .* flat"):
            export_cloud(path, cloud, format=format)
        count = len(kept) - (1 if format == "compressed_ply" else 0)  # the fifth is clear, and so left out there
        assert len(read_gaussians(path)) == count
    assert torch.equal(read_gaussians(path).means, cloud.means[kept])
    with user_warning("left out 5"):
        clean = cleaned(path, cloud)
    assert clean.opacities[clean.opacities.argmax()] == 16.0


def test_equal_values_in_a_chunk_are_kept(tmp_path):
    cloud = varied_cloud(degree=0)
    cloud.means[:, 2], cloud.sh[:], cloud.scales[:] = 0.25, 1.0, -3.0
    with silent():
        export_cloud(tmp_path / "a.compressed.ply", cloud, format="compressed_ply")
    found = read_gaussians(tmp_path / "a.compressed.ply")
    assert (found.means[:, 2] == 0.25).all()
    assert_close(found.sh, cloud.sh)
    assert_close(found.scales, cloud.scales)


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    cloud = varied_cloud(3)
    with value_error(f"`format` to be one of {', '.join(FORMATS)}, but got 'obj'"):
        export_cloud(tmp_path / "a.obj", cloud, format="obj")
    with pytest.raises(FileNotFoundError, match="is not a folder"):
        export_cloud(tmp_path / "no" / "a.splat", cloud, format="splat")
    with value_error("is a folder: name a file inside it"):
        export_cloud(tmp_path, cloud, format="splat")
    cloud.opacities[:] = -9.0
    with value_error("all Gaussians are fainter than 1/255"):
        export_cloud(tmp_path / "a.compressed.ply", cloud, format="compressed_ply")
    cloud.opacities[:] = math.nan
    with value_error("3 of 3 Gaussians mean nothing: `opacity` is NaN for 3, first at index 0"):
        export_cloud(tmp_path / "a.splat", cloud, format="splat")
    assert list(tmp_path.iterdir()) == []


# ---- USD


def _moved(cloud, shift, turn=False):
    return replace(cloud, means=cloud.means + shift, quats=cloud.quats[:, [1, 0, 3, 2]] if turn else cloud.quats)


def test_usd_round_trip(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    cloud = varied_cloud(20)
    white = replace(cloud, sh=torch.ones_like(cloud.sh))
    clouds = [_moved(cloud, 0.0), _moved(cloud, 0.1), _moved(cloud, 0.4), _moved(white, 0.5, turn=True)]
    path = tmp_path / "film.usdc"
    quarter = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y to z
    write_usd(path, clouds, fps=25.0, start=5, metres_per_unit=0.5, rotation=quarter)
    for k, expected in enumerate(clouds):
        arrays, found = usd_arrays(expected), read_usd_frame(path, 5 + k)
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_allclose(found[name], array, rtol=0, atol=1e-6, err_msg=name)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/World/Gaussians")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (5, 8, 25)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.5
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
    assert matrix.TransformDir((0, 1, 0)) == pytest.approx((0, 0, 1))
    assert prim.GetAttribute("positions").GetNumTimeSamples() == 4
    assert prim.GetAttribute("scales").GetNumTimeSamples() == 1
    assert prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").GetTimeSamples() == [5, 7, 8]
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 1
    low, high = (np.array(corner) for corner in prim.GetAttribute("extent").Get(8))
    shape = quat_to_rotation(clouds[3].quats) * clouds[3].scales.exp()[:, None, :]
    reach = 3 * shape.square().sum(-1).sqrt()
    np.testing.assert_allclose(low, (clouds[3].means - reach).amin(0).numpy(), atol=1e-5)
    np.testing.assert_allclose(high, (clouds[3].means + reach).amax(0).numpy(), atol=1e-5)


def test_usd_has_samples_of_shapes_only_where_one_is_seen_to_change(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    cloud = replace(varied_cloud(20), normals=None)
    clouds = [cloud]
    for k, angle in enumerate([4e-5, 8e-5, 4e-3, 4e-3]):  # rad, about x
        turn = torch.tensor([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]).expand(20, 4)
        quats = rotation_to_quat(quat_to_rotation(turn) @ quat_to_rotation(cloud.quats))
        turned = replace(_moved(cloud, 0.1 * k + 0.1), quats=quats)
        if k == 1:  # other numbers for the same shapes
            turned = replace(turned, quats=-quats, scales=cloud.scales + 1e-5)
        clouds.append(turned)
    write_usd(tmp_path / "film.usdc", clouds)
    stage = usd.Stage.Open(str(tmp_path / "film.usdc"))
    prim = stage.GetPrimAtPath("/World/Gaussians")
    samples = {name: prim.GetAttribute(name).GetTimeSamples() for name in ("positions", "orientations", "scales")}
    assert samples == {"positions": [0, 1, 2, 3, 4], "orientations": [0, 2, 3], "scales": [0]}
    for k, wanted in enumerate(clouds):
        found = {name: torch.from_numpy(array) for name, array in read_usd_frame(tmp_path / "film.usdc", k).items()}
        shape, known = covariance(found["orientations"], found["scales"].log()), covariance(wanted.quats, wanted.scales)
        assert ((shape - known).abs().amax((1, 2)) <= 1e-3 * known.diagonal(dim1=1, dim2=2).sum(1)).all()
        assert_close(found["positions"], wanted.means)


def test_usd_keeps_the_place_of_a_gaussian_that_is_not_finite(tmp_path):
    pytest.importorskip("pxr")
    cloud = varied_cloud(5)
    bad = _moved(cloud, 0.0)
    bad.means[2, 0], bad.quats[3] = math.nan, 0.0
    write_usd(tmp_path / "film.usda", [cloud, bad])
    found = read_usd_frame(tmp_path / "film.usda", 1)
    assert found["opacities"][[2, 3]].tolist() == [0.0, 0.0]
    assert all(np.isfinite(array).all() for array in found.values())
    np.testing.assert_allclose(found["positions"][[0, 1, 4]], cloud.means[[0, 1, 4]].numpy(), atol=1e-6)


def test_bad_films(tmp_path):
    pytest.importorskip("pxr")
    with value_error("there are no frames"):
        write_usd(tmp_path / "a.usdc", [])
    with value_error("Frame 1 has another number"):
        write_usd(tmp_path / "a.usdc", [varied_cloud(4), varied_cloud(5)])
    export_cloud(tmp_path / "one.usdc", varied_cloud(4), format="usd")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.usdc"]


def test_usd_without_its_library_is_one_sentence(tmp_path, monkeypatch):
    import sys

    usd_vol = pytest.importorskip("pxr.UsdVol")
    with monkeypatch.context() as changed:
        changed.delattr(usd_vol, "ParticleField3DGaussianSplat")
        with pytest.raises(ImportError, match=r"usd-core before 26\.3 has no splats: run pip install -U usd-core"):
            write_usd(tmp_path / "a.usdc", [varied_cloud(4)])
    for name in ("pxr", "pxr.Usd"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"USD files need usd-core: run pip install 'gaussian-swaying\[usd\]'"):
        export_cloud(tmp_path / "a.usdc", varied_cloud(4), format="usd")


# ---- files to files


def test_the_name_says_the_format(tmp_path):
    names = {"a.ply": "ply", "a.compressed.ply": "compressed_ply", "a.splat": "splat", "a.usdc": "usd", "a.usda": "usd"}
    assert {name: format_of(name) for name in names} == names
    with value_error(r"Cannot tell the format of a\.ksplat: .*\.splat"):
        format_of("a.ksplat")


@pytest.mark.parametrize(
    ("name", "last"),
    [
        ("point_cloud_#.ply", "point_cloud_11.ply"),
        ("frame####.compressed.ply", "frame0011.compressed.ply"),
        ("##.spz", "11.spz"),
        ("a_#.sog", "a_11.sog"),
    ],
)
def test_a_sequence_becomes_numbered_files(name, last, tmp_path):
    """From 0, with as many digits as there are places; their folder is made."""
    cloud = varied_cloud(20, degree=0)
    clouds = (_moved(cloud, 0.1 * k) for k in range(12))
    files = export_frames(tmp_path / "new" / name, clouds)
    assert sorted(files) == sorted((tmp_path / "new").iterdir())
    assert (len(files), files[-1].name) == (12, last)
    found = read_gaussians(files[-1])
    near(found.means.mean(0), cloud.means.mean(0) + 1.1, 1e-3)


def test_what_files_of_a_sequence_cannot_hold_is_told_once(tmp_path):
    with user_warning(r"0\.splat: harmonics .* 3 warnings like this in 3 files\.") as told:
        export_frames(tmp_path / "#.splat", [varied_cloud(20)] * 3)
    assert len(told) == 1


def test_a_sequence_becomes_a_film(tmp_path):
    pytest.importorskip("pxr")
    cloud = varied_cloud(20)
    assert export_frames(tmp_path / "film.usdc", (_moved(cloud, 0.1 * k) for k in range(3))) == [tmp_path / "film.usdc"]
    for k in range(3):
        found = read_usd_frame(tmp_path / "film.usdc", k)
        np.testing.assert_allclose(found["positions"], (cloud.means + 0.1 * k).numpy(), atol=1e-6)
