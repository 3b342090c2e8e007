"""Layers of sand on inclines, and one thrown up."""

import pytest
from bench.problems.granular.layers import angle_of_repose, inclined_layer, tossed_layer
from bench.problems.settings import Settings


def test_layer_stands_at_30_and_flows_at_40(device):
    gain, speed, _ = inclined_layer([30.0, 40.0], Settings(device=str(device)), cells=4, seconds=0.4)
    assert abs(gain[0]) < 5e-3
    assert abs(speed[0]) < 0.02  # 1.6 without friction
    assert 0.05 < gain[1] < 0.113  # theory, which the dissipation of the grid keeps it below
    assert speed[1] > 0.15


@pytest.mark.slow(twin="test_layer_stands_at_30_and_flows_at_40")
def test_angle_of_repose_is_that_of_simple_shear():
    found = angle_of_repose(cells=4, seconds=0.2, angles=(33, 34, 35, 36))
    assert (found["stands"], found["flows"]) == (34, 35)
    assert found["friction_deg"] == pytest.approx(found["exact"], abs=0.5)
    assert found["acceleration_error"] < 0


@pytest.mark.parametrize(("cells", "seconds"), [(3, 0.25), pytest.param(4, 0.3, marks=pytest.mark.slow)])
def test_volume_correction_takes_back_the_gaps(cells, seconds):
    kept, grown = (tossed_layer(volume_correction=c, cells=cells, seconds=seconds) for c in (True, False))
    assert kept["highest"] > 1.1
    assert abs(kept["error"]) < 0.02
    assert grown["error"] > 0.1
