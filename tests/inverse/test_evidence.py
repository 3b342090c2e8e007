"""Residuals of points that are followed: their weights and clusters."""

import pytest
import torch

from gaussian_swaying.inverse.evidence import LEAST_FACING, PATCHES, Evidence, compare, explained, facing
from gaussian_swaying.inverse.tracks import Tracks
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.inverse.videos import read_videos
from gaussian_swaying.rendering.cameras.camera import look_at_camera


def test_points_that_are_seen_edge_on_count_little():
    """By the cosine of the angle between the ray and the normal."""
    camera = look_at_camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 60, 40)
    normals = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.8, 0.0], [1.0, 0.0, 0.0]])
    found = facing(normals, torch.zeros(4, 3), camera)
    assert found.tolist() == pytest.approx([1.0, 1.0, 0.8, LEAST_FACING], abs=1e-6)


def _nothing(simulation, video):
    """Evidence of all Gaussians at the corner of every frame."""
    count, frames = len(simulation.scene.moving), len(video.times)
    seen = torch.ones(frames, count, dtype=torch.bool)
    return Evidence(simulation, video, Tracks(torch.arange(count), torch.zeros(frames, count, 2).double(), seen))


def test_residuals_are_those_in_pixels_times_their_weight(own, simulation):
    (left, _) = read_videos(own / "video")
    evidence = _nothing(simulation, left)
    shown = evidence.shown(next(states_of(simulation, [{}], [0.0])))
    expected = facing(simulation.scene.rest().normals[simulation.scene.moving], evidence.rest, left.cameras[0])
    assert expected.min() < 0.95
    torch.testing.assert_close(evidence.beside(shown, 0)[0], evidence.pixels(shown, 0) * expected[:, None])


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
    tracks = Tracks(torch.arange(len(simulation.scene.moving))[-4:], position, seen)
    found = explained(simulation, [video], [tracks], {}, video.times)[video.name]
    assert found == pytest.approx(float(moved[:3].sum() / (moved[:3].sum() + slipped)), rel=1e-3)


def test_tracks_share_their_clusters_over_cameras(own, simulation):
    """A track's error is that of a place of the object, whoever sees it."""
    parts = [_nothing(simulation, video) for video in read_videos(own / "video")]
    found = compare(simulation, parts, [{}, {}], parts[0].video.times[:3])
    count = len(simulation.scene.moving)
    assert found.values.shape == (2, 2 * 2 * count, 2)  # two cameras at two times after the start
    own_clusters = found.cluster.reshape(4, count)
    assert (own_clusters == own_clusters[0]).all()
    assert set(found.cluster.tolist()) == set(range(PATCHES**2))
    assert found.moment.unique().tolist() == [1, 2]
