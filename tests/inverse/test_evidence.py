"""Residuals of pictures and silhouettes: as small as the noise at the truth, and larger away from it."""

import dataclasses

import pytest
import torch
from shared import randn, seeded, value_error

from gaussian_swaying.inverse import evidence
from gaussian_swaying.inverse.evidence import (
    LEAST_FACING,
    PATCHES,
    Evidence,
    PictureEvidence,
    TrackEvidence,
    compare,
    facing,
)
from gaussian_swaying.inverse.least_squares import Block, scales_of
from gaussian_swaying.inverse.tracks import Tracks
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.inverse.videos import Footage, read_videos
from gaussian_swaying.rendering.cameras.camera import look_at_camera


@pytest.mark.parametrize("masks", [False, True])
def test_pictures_at_the_truth_and_away_from_it(own, simulation, masks):
    (left, _) = read_videos(own / "video")
    evidence = PictureEvidence(left, masks, width=50)
    (block,) = compare(simulation, [evidence], [{}, {"wind.speed": 8.0}], left.times[:5])
    assert block.kind == ("silhouettes" if masks else "pixels")
    assert block.values.shape == (2, 4 * 30 * 50, 1 if masks else 3)  # not the frame at rest
    assert block.cluster.shape == (4 * 30 * 50,)
    assert sorted(block.cluster.unique().tolist()) == list(range(PATCHES**2))
    here, away = block.values.square().mean((-1, -2)).sqrt().tolist()
    assert here < 2 / 255  # noise of two grey levels, averaged over 4 x 4 pixels, and rounding
    assert away > 10 * here


def test_scales_are_those_of_normal_noise():
    generator = seeded(0)
    for count in (1, 2, 3):
        values = 0.3 * randn(1, 4000, count, generator=generator)
        values[:, :200] = 50.0
        block = Block("tracks", values, torch.zeros(4000, dtype=torch.long))
        assert scales_of([block], {"tracks": 0.0})["tracks"] == pytest.approx(0.3, rel=0.1)


def test_points_that_are_seen_edge_on_count_little():
    """By the cosine of the angle between the ray and the normal."""
    camera = look_at_camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 60, 40)
    normals = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.8, 0.0], [1.0, 0.0, 0.0]])
    found = facing(normals, torch.zeros(4, 3), camera)
    assert found.tolist() == pytest.approx([1.0, 1.0, 0.8, LEAST_FACING], abs=1e-6)


def test_weighed_tracks_are_those_times_their_weight(own, simulation):
    (left, _) = read_videos(own / "video")
    index = torch.arange(5)
    tracks = Tracks(index, torch.zeros(13, 5, 2).double(), torch.ones(13, 5, dtype=torch.bool))
    states = next(states_of(simulation, [{}], [0.0]))
    plain, weighed = (
        part.beside(part.shown(simulation, states), 0)[0]
        for part in (TrackEvidence(simulation, left, tracks, w) for w in (False, True))
    )
    normals = simulation.scene.rest().normals[simulation.scene.moving[index]]
    expected = facing(normals, TrackEvidence(simulation, left, tracks).rest, left.cameras[0])
    assert expected.max() < 0.99
    torch.testing.assert_close(weighed, plain * expected[:, None])


def test_silhouettes_need_masks(own, fit_of):
    videos = [dataclasses.replace(video, masks=None) for video in read_videos(own / "video")]
    with value_error("no silhouettes"):
        fit_of({"wind.speed": [1, 9]}, videos=videos, stages=("silhouettes",))


def test_tracks_share_their_clusters_over_cameras_and_pictures_do_not(monkeypatch):
    """A track's error is that of a place of the object, whoever sees it; a patch of a picture is a camera's own."""

    class Given(Evidence):
        floor = 1.0

        def __init__(self, kind):
            super().__init__(Footage("a", (0.0, 0.5, 1.0), (), torch.zeros(3, 1, 1, 3, dtype=torch.uint8)))
            self.kind = kind

        def shown(self, simulation, states):
            return states

        def beside(self, shown, frame):
            return torch.zeros(len(shown), PATCHES**2, 1), torch.arange(PATCHES**2)

    monkeypatch.setattr(evidence, "states_of", lambda _, values, times, **__: [[None] * len(values) for _ in times])
    parts = [Given(kind) for kind in ("pixels", "tracks", "pixels", "tracks", "pixels")]
    found = {block.kind: block for block in compare(None, parts, [{}, {}], (0.0, 0.5, 1.0))}
    patches = set(range(PATCHES**2))
    assert found["tracks"].values.shape == (2, 2 * 2 * len(patches), 1)  # two cameras at two times after the start
    assert set(found["tracks"].cluster.tolist()) == patches
    own = found["pixels"].cluster.reshape(2, 3, -1)  # times, cameras
    assert torch.equal(own[0], own[1])
    assert len(own.unique()) == 3 * len(patches)
    assert 0 <= int(own.min()) < int(own.max()) < len(parts) * len(patches)
