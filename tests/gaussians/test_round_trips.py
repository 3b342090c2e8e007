import math
import re
import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from other_writers import assert_same, in_order
from shared import silent, user_warning, value_error
from small_scenes import varied_cloud

from gaussian_swaying.gaussians.cloud import joined
from gaussian_swaying.gaussians.formats import export_cloud, read_gaussians
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.simulation.body import Scene

# half a step of 8 bits each: the logarithm of the size, opacities, colours; harmonics are rounded once more, to 4 bits
SPZ = {"scales": 1.01 / 32, "opacities": 0.501 / 255, "colors": 0.501 / 255 / 0.15, "sh": 8.51 / 128}
# three components within half a step of 1 / (511 sqrt(2)); the fourth, at least 1/2, follows from them
SMALLEST_THREE = 2 * 2 * 0.5 / (511 * 2**0.5) * 3**0.5
FORMATS = {
    "splat": {  # of 8 bits that are cut off, not rounded: each of four components is off by at most 1 / 128
        "means": 0, "scales": 1e-5, "opacities": 1.01 / 255, "colors": 1.01 / 255 / SH_DC, "sh": 0,
        "quats": 2 * 2 * 1.01 / 128,
    },
    "compressed.ply": {  # three components of the rotation within half a step of sqrt(2) / 1023
        "means": 4 / 1023, "scales": 2 / 1023, "opacities": 1 / 255, "colors": 1 / 255 / SH_DC, "sh": 8 / 256,
        "quats": 4 * 2**0.5 / 1023,
    },
    "sog": {  # centres within half of 2^-16 of the logarithmic range from -1 to 3, the rest of an even code book
        "means": math.log(4) / 65535 * 4, "scales": 2 / 255, "opacities": 0.501 / 255, "colors": 0.8 / 255,
        "sh": 0.8 / 255, "quats": 2 * 2 * 0.5 * 2**0.5 / 255 * 3**0.5,
    },
    # centres have 24 bits, of numbers up to 3; w follows from bytes of x, y, z, however small it is
    "2.spz": SPZ | {"means": 2.0**-21, "quats": 0.2},
    "3.spz": SPZ | {"means": 2.0**-21, "quats": SMALLEST_THREE},
    "4.spz": SPZ | {"means": 2.0**-21, "quats": SMALLEST_THREE},
}  # fmt: skip


def _version(kind):
    return {"spz_version": int(kind[0])} if "spz" in kind else {}


@pytest.mark.parametrize(
    ("kind", "degree"), [(kind, degree) for kind in FORMATS for degree in range(4) if kind != "splat" or not degree]
)
def test_round_trip(kind, degree, tmp_path):
    if kind == "4.spz":
        pytest.importorskip("zstandard")
    cloud, path = varied_cloud(degree=degree), tmp_path / f"a.{kind}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is cut off
        export_cloud(path, cloud, **_version(kind))
    found = read_gaussians(path)
    assert_same(in_order(found, cloud), cloud, **FORMATS[kind])
    assert found.normals is None
    path.rename(tmp_path / f"A.{kind.rpartition('.')[2].upper()}")
    (renamed,) = tmp_path.iterdir()
    assert len(Scene(ply=renamed).cloud()) == len(cloud)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("kind", ["3.spz", "4.spz", "sog", "glb"])
def test_reading_takes_no_more_memory_than_is_reckoned(kind, degree, tmp_path):
    if kind == "4.spz":
        pytest.importorskip("zstandard")
    count, path = 20_000, tmp_path / f"a.{kind}"
    export_cloud(path, varied_cloud(count, degree=degree), **_version(kind))
    read_gaussians(path)  # modules are loaded
    tracemalloc.start()
    held = read_gaussians(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * count * (44 + 12 * held.sh.shape[1]) + (1 << 17)


THIN = {"scales": -11.0}
STRONG, BRIGHT, FAINT = {"sh": 5.0}, {"sh": 20.0}, {"opacities": -7.0}
WIDE, TINY = {"scales": 7.0}, {"scales": -19.0}


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        ("spz", THIN, "3 of 300 Gaussians have a size below 4.5e-05, which becomes that: up to 2.72 times as thick"),
        ("spz", WIDE, "3 of 300 Gaussians have a size above 379, which becomes that: the largest is 1.1e+03"),
        ("spz", STRONG, "3 of 300 Gaussians have harmonics up to ±5, which are cut off at ±1"),
        ("spz", STRONG, "3 of 300 Gaussians have a colour that is cut off"),
        ("splat", BRIGHT, "3 of 300 Gaussians have a colour that is cut off; harmonics of degree 1 and above are left"),
        ("compressed.ply", STRONG, "3 of 300 Gaussians have harmonics up to ±5, which are cut off at ±4"),
        ("compressed.ply", FAINT, "3 of 300 Gaussians are fainter than 0.0039 and left out"),
        ("compressed.ply", {"scales": -21.0}, "a size below 2.1e-09, which becomes that: up to 2.72 times as thick"),
        ("sog", TINY, "3 of 300 Gaussians are smaller than the steps of their centres"),
        (
            "spz",
            {"origin": (5e5, 4e6, 3e2)},
            "centres count from [500000.0, 4000000.0, 300.0], which the file does not",
        ),
    ],
)
def test_what_a_format_cannot_hold_is_counted(kind, changes, words, tmp_path):
    cloud = varied_cloud()
    for name, value in changes.items():
        if name == "origin":
            cloud = replace(cloud, origin=value)
        else:
            getattr(cloud, name)[[3, 50, 99]] = value
    with user_warning(re.escape(words)) as told:
        export_cloud(tmp_path / f"a.{kind}", cloud)
    assert len(told) == 1
    with silent():
        for whole in ("ply", "glb"):
            export_cloud(tmp_path / f"a.{whole}", cloud)


@pytest.mark.parametrize("kind", ["spz", "compressed.ply"])
def test_steps_of_centres_are_those_of_the_file(kind, tmp_path):
    """One far Gaussian takes the bits of all others in SPZ, and of those in its chunk of a compressed .ply."""
    cloud = varied_cloud(600, degree=0)
    cloud.means[7] = 1e6
    with user_warning("Gaussians are smaller than the steps of their centres") as told:
        export_cloud(tmp_path / f"a.{kind}", cloud)
    found = read_gaussians(tmp_path / f"a.{kind}")
    apart = torch.cdist(cloud.means.double(), found.means.double()).amin(1)
    moved = int((apart > cloud.scales.amax(1).exp()).sum())
    counted = int(str(told[0].message).split(": ")[1].split(" of ")[0])
    assert 0 < moved <= counted < 600
    if kind == "spz":
        assert (found.means * 8 == (found.means * 8).round()).all()
        assert counted == (cloud.scales.amax(1).exp() < 0.125).sum()


# ---- map coordinates

UTM = (500123.0, 4649776.5, 312.25)
HALF_A_STEP = 2.0**-24 * 8  # of float32 within the cloud


def _places(cloud):
    return cloud.means.double().numpy() + cloud.origin


def _assert_same_places(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=HALF_A_STEP)


def _far(**kinds):
    return replace(varied_cloud(**kinds), origin=UTM)


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_map_coordinates_survive(kind, tmp_path):
    cloud, path = _far(), tmp_path / f"a.{kind}"
    export_cloud(path, cloud, rotation=torch.eye(3))
    found = read_gaussians(path)
    assert max(map(abs, found.origin)) > 4e6
    assert found.means.abs().max() < 8
    x, y, z = _places(found).T
    _assert_same_places(np.stack([x, -z, y] if kind == "glb" else [x, y, z], 1), _places(cloud))
    model = GaussianSurfaceModel(found.select(torch.arange(7)))
    model.save_ply(tmp_path / "b.ply")
    some = model.deformed(model.means, torch.eye(3).expand(7, 3, 3)).to_cloud()
    near = (found.origin[0] + 1, found.origin[1], found.origin[2])
    for again in (some, read_gaussians(tmp_path / "b.ply"), model.part_to_cloud(torch.arange(7)), some.rebased(near)):
        _assert_same_places(_places(again), _places(found)[:7])


def test_float32_map_coordinates_are_read_exactly(tmp_path):
    cloud = _far()
    far = replace(cloud, means=torch.from_numpy(_places(cloud)).float(), origin=(0.0, 0.0, 0.0))
    export_cloud(tmp_path / "a.ply", far)
    assert (_places(read_gaussians(tmp_path / "a.ply")) == far.means.double().numpy()).all()


def test_splats_with_different_origins_are_joined():
    cloud = _far(count=20)
    shifted = cloud.rebased((500120.0, 4649770.0, 300.0))
    both = joined(cloud, shifted)
    _assert_same_places(_places(both)[:20], _places(cloud))
    _assert_same_places(_places(both)[20:], _places(shifted))
    assert joined(cloud, varied_cloud(20)).origin == (0.0, 0.0, 0.0)


def test_a_film_is_moved_to_its_origin(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    geom = pytest.importorskip("pxr.UsdGeom")
    cloud = _far(count=5)
    export_cloud(tmp_path / "a.usda", cloud, rotation=torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    place = geom.Xformable(stage.GetPrimAtPath("/World/Gaussians")).ComputeLocalToWorldTransform(0)
    x, y, z = _places(cloud)[3]
    assert place.Transform(tuple(cloud.means[3].double().tolist())) == pytest.approx((x, -z, y), rel=0, abs=HALF_A_STEP)


def test_a_scene_says_where_its_coordinates_begin(tmp_path):
    export_cloud(tmp_path / "a.ply", _far())
    scene = Scene(ply=tmp_path / "a.ply", region=Box([500120.0, 4649770.0, 300.0], [500130.0, 4649780.0, 330.0]))
    with value_error(r"No Gaussian is .*; coordinates count from \[50012\d\.\d, 464977\d\.\d, 31"):
        scene.select(scene.cloud())
