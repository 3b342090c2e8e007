"""Every format, written and read again: as it was within the bits of each field."""

import math

import pytest
from other_writers import assert_same, in_order
from small_scenes import varied_cloud

from gaussian_swaying.gaussians.export import export_cloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.simulation.scene import Scene

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
    # centres are half floats, or have 24 bits, of numbers up to 3; w follows from bytes of x, y, z, however small it is
    "1.spz": SPZ | {"means": 2.0**-10, "quats": 0.2},
    "2.spz": SPZ | {"means": 2.0**-21, "quats": 0.2},
    "3.spz": SPZ | {"means": 2.0**-21, "quats": SMALLEST_THREE},
    "4.spz": SPZ | {"means": 2.0**-21, "quats": SMALLEST_THREE},
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "degree"), [(kind, degree) for kind in FORMATS for degree in range(4) if kind != "splat" or not degree]
)
def test_round_trip(kind, degree, tmp_path):
    if kind == "4.spz":
        pytest.importorskip("zstandard")
    cloud, path = varied_cloud(degree=degree), tmp_path / f"a.{kind}"
    export_cloud(path, cloud, **({"spz_version": int(kind[0])} if "spz" in kind else {}))
    found = read_gaussians(path)
    assert_same(in_order(found, cloud), cloud, **FORMATS[kind])
    assert found.normals is None
    path.rename(tmp_path / f"A.{kind.rpartition('.')[2].upper()}")
    (renamed,) = tmp_path.iterdir()
    assert len(Scene(ply=renamed).cloud()) == len(cloud)
