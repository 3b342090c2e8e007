"""Unknowns, and other values that may explain the same film."""

import math
from types import SimpleNamespace

import pytest
import torch
from shared import value_error
from small_films import changed

from gaussian_swaying.inverse.plan import Unknown, apart_by, mirror_of, mirrored, read_unknown
from gaussian_swaying.inverse.variants import check_variants
from gaussian_swaying.wind.field import flow_of

pytest.importorskip("cv2", reason="needs the extra [fit]")


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_value_and_share_are_inverse(scale):
    unknown = Unknown("material.E", 1e3, 1e5, scale)
    for share in (0.0, 0.3, 1.0):
        assert unknown.share(unknown.value(share)) == pytest.approx(share)
        step = 1e-6
        slope = (unknown.value(share + step) - unknown.value(share - step)) / (2 * step)
        assert unknown.slope(share) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "low", "high", "words"),
    [
        ("material.stiffness", 1, 2, "cannot be sought"),
        ("material.E", 2, 1, "[low, high]"),
        ("material.E", 0, 1, "from 0.001"),
        ("aero.C_D", -1, 1, "from 0 to"),
        ("material.nu", 0.1, 0.6, "range"),
    ],
)
def test_bad_ranges(name, low, high, words):
    with value_error(r".") as error:
        Unknown(name, low, high)
    assert words in str(error.value)
    assert name in str(error.value)


def test_what_has_no_place_is_refused(simulation, tmp_path):
    with value_error("There is no"):
        check_variants(simulation, [Unknown("wind.modulations.0.amplitude", 0.0, 1.0)])
    still = changed(tmp_path, wind={"flow": [0.0, 0.0, 0.0]})
    with value_error(r"no `wind.flow`"):
        check_variants(still, [Unknown("wind.azimuth", 0.0, 90.0)])


def test_the_wind_is_mirrored_at_the_normal_of_a_sheet(simulation):
    """The flag is nearly the plane of x and z: a wind along +x + y has the same pressure as one along -x + y."""
    assert mirrored(simulation.model, 56.0) == pytest.approx(124.0, abs=3.0)
    patches = simulation.scene.patches
    pressed = []
    for azimuth in (56.0, mirrored(simulation.model, 56.0)):
        flow = torch.tensor(flow_of((3.0, 0.0, 0.0), {"wind.azimuth": azimuth}))
        pressed.append(float((patches.area * (patches.normal @ flow).square()).sum()))
    assert pressed[1] == pytest.approx(pressed[0], rel=1e-4)


def test_a_wind_across_a_sheet_or_along_it_is_its_own_mirror_image(simulation):
    """Along it, the image blows the other way: a flag would be on the other side of its pole, which a fit can try."""
    assert mirrored(simulation.model, 90.0) is None
    assert math.cos(math.radians(mirrored(simulation.model, 0.0))) == pytest.approx(-1, abs=0.01)


def test_a_large_patch_counts_as_its_area():
    """Nine patches that face x have less area than the one that faces y, at which the wind is mirrored."""
    normal = torch.tensor([[1.0, 0.0, 0.0]] * 9 + [[0.0, 1.0, 0.0]])
    area = torch.tensor([0.001] * 9 + [0.5])
    model = SimpleNamespace(scene=SimpleNamespace(patches=SimpleNamespace(normal=normal, area=area)))
    assert mirrored(model, 56.0) == pytest.approx(124.0)


def test_a_body_that_faces_all_ways_has_no_mirror_image(simulation):
    patches = simulation.scene.patches
    turn = torch.linspace(0, math.pi, len(patches.normal))
    normal, own = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1), patches.normal
    patches.normal = normal
    try:
        assert mirrored(simulation.model, 56.0) is None
    finally:
        patches.normal = own


def test_the_mirrored_wind_lies_within_its_range(simulation):
    sought = [read_unknown("wind.azimuth", [-80.0, 160.0]), read_unknown("material.E", [1e3, 1e5])]
    (other,) = mirror_of(simulation.model, sought, [0.5, 0.95])
    assert sought[0].value(other[0]) == pytest.approx(140.0, abs=3.0)
    assert other[1] == 0.95
    narrow = [read_unknown("wind.azimuth", [0.0, 90.0])]
    assert mirror_of(simulation.model, narrow, [0.5]) == []  # 135 degrees is known to be wrong
    around = [read_unknown("wind.azimuth", [150.0, 450.0])]
    (again,) = mirror_of(simulation.model, around, [0.6])  # 330 degrees is -30
    assert around[0].value(again[0]) == pytest.approx(210.0, abs=3.0)


def test_a_fit_tries_it_at_its_end(simulation, fit_of):
    """And says if it fits better."""
    made = fit_of({"wind.azimuth": [0.0, 180.0]})
    made._brief = lambda places, evidence, times: list(zip([1.0, 2.0], places[::-1], strict=True))
    (other,) = made.others([0.3], [])
    assert other == made.values(mirror_of(simulation.model, made.plan.unknowns, [0.3])[0])
    assert other["wind.azimuth"] == pytest.approx(180 - 54, abs=3.0)


def test_the_mirrored_wind_is_a_rival_for_longer(fit_of):
    """It differs by less than a model's errors."""
    made = fit_of({"wind.azimuth": [0.0, 180.0]})
    for end, cost, told in ((0.7, 1.2, True), (0.65, 1.2, True), (0.7, 1.3, False), (0.95, 1.2, False)):
        made._brief = lambda places, evidence, times, end=end, cost=cost: [(1.0, places[0]), (cost, [end])]
        assert made.others([0.3], []) == [made.values([end])] * told


def test_azimuths_that_are_a_turn_apart_are_the_same():
    sought = [read_unknown("wind.azimuth", [-200.0, 200.0]), read_unknown("wind.speed", [1.0, 9.0])]
    at = [sought[0].share(179.0), 0.5]
    assert apart_by(sought, at, [sought[0].share(-179.0), 0.5]) == pytest.approx(2 / 400)
    assert apart_by(sought, at, [sought[0].share(139.0), 0.5]) == pytest.approx(40 / 400)
    assert apart_by(sought, at, [at[0], 0.3]) == pytest.approx(0.2)
