"""Residuals of points that are followed: their weights, clusters, and trust in them."""

from dataclasses import replace

import pytest
import torch
from small_films import changed

import gaussian_swaying.inverse.variants as module
from gaussian_swaying.inverse.tracks import PATCHES, Tracks, track
from gaussian_swaying.inverse.variants import NOISE, compare, explained, split, states_of, trusted
from gaussian_swaying.inverse.videos import read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")


def _nothing(simulation, video):
    """Tracks of all Gaussians at the corner of every frame."""
    count, frames = len(simulation.scene.moving), len(video.times)
    seen = torch.ones(frames, count, dtype=torch.bool)
    return Tracks(simulation, video, torch.arange(count), torch.zeros(frames, count, 2).double(), seen)


def test_a_track_that_slips_explains_nothing_and_no_less(own, simulation):
    """Of four points one stays within a pixel or two of where it was, and the simulation goes far."""
    video, _ = read_videos(own / "video")
    whole, states = _nothing(simulation, video), states_of(simulation, [{}], video.times)
    position = torch.stack([whole.pixels(whole.shown(one), k)[0, -4:] for k, one in enumerate(states)]).double()
    moved = (position - position[:1]).square().sum((0, 2))
    position[1:, 3] = position[0, 3] + 1.0
    slipped = 2.0 * (len(position) - 1)
    assert moved[3] > 10 * slipped
    seen = torch.ones(position.shape[:2], dtype=torch.bool)
    tracks = Tracks(simulation, video, torch.arange(len(simulation.scene.moving))[-4:], position, seen)
    found = explained([split(tracks)[1]], {}, video.times)[video.name]
    assert found == pytest.approx(float(moved[:3].sum() / (moved[:3].sum() + slipped)), rel=1e-3)


def test_tracks_share_their_clusters_over_cameras(own, simulation):
    """A track's error is that of a place of the object, whoever sees it."""
    parts = [_nothing(simulation, video) for video in read_videos(own / "video")]
    (found,) = compare(parts, [{}, {}], parts[0].video.times[:3])
    count = len(simulation.scene.moving)
    assert found.values.shape == (2, 2 * 2 * count, 2)  # two cameras at two times after the start
    own_clusters = found.cluster.reshape(4, count)
    assert (own_clusters == own_clusters[0]).all()
    assert set(found.cluster.tolist()) == set(range(PATCHES**2))
    assert found.moment.unique().tolist() == [1, 2]


@pytest.fixture
def left(own, simulation):
    (video, _) = read_videos(own / "video")
    return track(simulation, video, 40)


def test_points_count_by_how_far_another_grid_moves_them(own, left):
    """By 1 / sqrt(1 + d^2 / n^2), with the distance d in each coordinate; at rest they count as before."""
    finer = changed(own, solver={"dx": 0.08})
    times = left.video.times[:7]
    (part,) = trusted([left], [finer], {}, times)
    compared = {"own": left, "other": replace(left, simulation=finer), "less": part}
    values = {name: compare([one], [{}], times, moving=True)[0].values[0] for name, one in compared.items()}
    away = (values["other"] - values["own"]).norm(dim=-1)
    expected = (1 + 0.5 * away.square() / NOISE**2).rsqrt()
    first = int(left.seen[0].sum())
    assert expected[:first].tolist() == pytest.approx([1.0] * first, abs=1e-4)
    assert expected.min() < 0.9
    torch.testing.assert_close(values["less"], expected[:, None] * values["own"], rtol=1e-3, atol=1e-4)


def test_a_grid_on_which_the_scene_diverges_says_nothing(simulation, left, monkeypatch):
    pixels = module.pixels_of
    calls = []

    def lost(*given):
        calls.append(given)
        return [[torch.nan * own if len(calls) == 2 else own for own in part] for part in pixels(*given)]

    monkeypatch.setattr(module, "pixels_of", lost)
    (part,) = trusted([left], [simulation, simulation], {}, left.video.times[:3])
    assert (part.trust == 1).all()
