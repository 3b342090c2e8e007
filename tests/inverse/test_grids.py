"""Points that another grid moves otherwise count less."""

import math

import pytest
import torch
from small_films import changed

from gaussian_swaying.inverse.evidence import NOISE, Evidence, compare, distrust, trusted
from gaussian_swaying.inverse.tracks import track
from gaussian_swaying.inverse.videos import read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")


@pytest.fixture
def left(own, simulation):
    (video, _) = read_videos(own / "video")
    return Evidence(simulation, video, track(simulation, video, 40))


def test_points_count_by_how_far_another_grid_moves_them(own, simulation, left):
    """By 1 / sqrt(1 + d^2 / n^2), with the distance d in each coordinate; at rest they count as before."""
    finer = changed(own, solver={"dx": 0.08})
    times = left.video.times[:7]
    (part,) = trusted(simulation, [finer], [left], {}, times)
    compared = {"own": (simulation, left), "other": (finer, left.on(finer)), "less": (simulation, part)}
    values = {name: compare(scene, [e], [{}], times, moving=True).values[0] for name, (scene, e) in compared.items()}
    weight = left._weight[left.tracks.seen[0]]
    weights = torch.cat([left._weight[seen] for seen in left.tracks.seen[:7]])
    away = ((values["other"] - values["own"]) / weights).norm(dim=-1)
    expected = (1 + 0.5 * away.square() / NOISE**2).rsqrt()
    assert expected[: len(weight)].tolist() == pytest.approx([1.0] * len(weight), abs=1e-4)
    assert expected.min() < 0.9
    torch.testing.assert_close(values["less"], expected[:, None] * values["own"], rtol=1e-3, atol=1e-4)


def test_a_grid_on_which_the_scene_diverges_says_nothing(simulation, left, monkeypatch):
    from gaussian_swaying.inverse import evidence as grids

    pixels = grids._pixels
    calls = []

    def lost(*given):
        calls.append(given)
        return [(*key, torch.nan * own if len(calls) == 2 else own) for *key, own in pixels(*given)]

    monkeypatch.setattr(grids, "_pixels", lost)
    (part,) = trusted(simulation, [simulation, simulation], [left], {}, left.video.times[:3])
    assert (part.trust == 1).all()


def test_less_trust_is_no_better_fit(left):
    """The likelihood has its logarithm for both coordinates, of the points that are seen in the frames compared."""
    times = left.video.times[:4]
    trust = torch.full(left.tracks.seen.shape, 1.0, dtype=torch.float64)
    trust[2] = 0.5
    seen = left.tracks.seen[:4]
    expected = 2 * math.log(2) * int(seen[2].sum()) / int(seen.sum())
    assert distrust([left], times) == 0.0
    left.trust = trust
    assert distrust([left], times) == pytest.approx(expected)
