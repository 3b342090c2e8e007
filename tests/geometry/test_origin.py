import numpy as np
import pytest

from gaussian_swaying.geometry.origin import NO_ORIGIN, origin_of

UTM = np.array([500123.25, 4649776.5, 312.0])


def _places(size=1.0, count=2000):
    return size * np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))


@pytest.mark.parametrize("size", [1e-3, 1.0, 300.0])
@pytest.mark.parametrize("shift", [1e3, 1e7])  # sizes
def test_float32_keeps_what_float64_has(size, shift):
    """To its half step at the largest coordinate, as if the places had never been far away."""
    places = _places(size) + size * shift * UTM / UTM.max()
    origin = origin_of(places)
    assert any(origin)
    near = places - origin
    assert np.abs(near).max() < 1.2 * size
    assert np.abs(near.astype(np.float32) - near).max() <= 2.0**-24 * 1.2 * size


def test_float32_places_are_kept_exactly():
    places = (_places(20.0) + UTM).astype(np.float32)
    near = (places - origin_of(places)).astype(np.float32)
    assert np.array_equal(near + np.array(origin_of(places)), places.astype(np.float64))


@pytest.mark.parametrize(
    "places",
    [_places() + 100.0, np.full((7, 3), 0.3), np.zeros((0, 3)), np.full((4, 3), np.nan)],
    ids=["near", "one place", "none", "no number"],
)
def test_there_is_none_unless_it_helps(places):
    assert origin_of(places) == NO_ORIGIN


def test_what_lies_apart_does_not_count():
    places = _places() + UTM
    expected = origin_of(places)
    places[:50] *= 1e3
    places[50:60] = np.nan
    assert np.abs(np.subtract(origin_of(places), expected)).max() <= 0.5
