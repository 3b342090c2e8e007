"""The tracker: pictures that are shifted by a known amount, and a simulation that is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaussian_swaying.fitting.ensemble import Ensemble
from gaussian_swaying.fitting.evidence import TrackEvidence
from gaussian_swaying.fitting.tracks import match, track
from gaussian_swaying.fitting.videos import read_videos

cv2 = pytest.importorskip("cv2", reason="needs the extra [fit]")


def test_follow_a_shift():
    from gaussian_swaying.fitting.tracks import follow

    rows, columns = np.mgrid[0:80, 0:100].astype("f4")

    def picture(x, y):
        wave = np.sin(0.35 * (columns - x)) * np.cos(0.3 * (rows - y)) + np.sin(0.21 * (rows - y) + 0.1 * (columns - x))
        return np.repeat((127 + 55 * wave)[..., None], 3, -1).round().astype("u1")

    shifts = [(0.0, 0.0), (0.7, -0.4), (1.9, -0.9), (3.2, -1.1)]
    start = np.stack(np.meshgrid(np.arange(25, 75, 10.0), np.arange(25, 55, 10.0)), -1).reshape(-1, 2)
    position, seen = follow(np.stack([picture(*shift) for shift in shifts]), start)
    assert seen.all()
    for k, shift in enumerate(shifts):
        assert np.abs(position[k] - start - shift).max() < 0.05


def test_a_point_that_vanishes_is_lost():
    from gaussian_swaying.fitting.tracks import follow

    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (60, 60, 3), dtype="u1"), (7, 7), 0)
    plain = np.full_like(picture, 128)
    _, seen = follow(np.stack([picture, picture, plain]), np.array([[20.0, 20.0], [30.0, 40.0], [45.0, 25.0]]))
    assert seen[1].all()
    assert not seen[2].any()


def test_matches_do_not_drift(own, simulation):
    """Against the truth: tracks go astray by a pixel or so, matches from a nearby simulation by a part of that."""
    videos = read_videos(own / "video")
    ensemble, times = Ensemble(simulation), list(videos[0].times)
    truth = [states[0] for states in ensemble.run([{}], times)]
    near = [states[0] for states in ensemble.run([{"wind.speed": 4.7, "material.E": 1.2e4}], times)]
    for video in videos:
        tracks, matches = track(simulation, video), match(simulation, video, near)
        off = {}
        for name, found in (("tracks", tracks), ("matches", matches)):
            evidence = TrackEvidence(simulation, video, found)
            parts = [evidence.residuals(simulation, [truth[k]], k)[0][0] for k in range(4, len(times))]
            off[name] = float(torch.cat(parts).norm(dim=-1).median())
        assert off["matches"] < 0.25
        assert off["matches"] < off["tracks"] < 2


def test_a_shift_that_is_there_at_rest_is_taken_off_matches(own, simulation):
    """The same video, said to be from cameras whose pictures are shifted by a part of a pixel."""
    video = read_videos(own / "video")[0]
    turned = []
    for camera in video.cameras:
        intrinsics = camera.intrinsics.clone()
        intrinsics[:2, 2] += torch.tensor([0.6, -0.4])
        turned.append(replace(camera, intrinsics=intrinsics))
    times = video.times[:5]
    states = [found[0] for found in Ensemble(simulation).run([{}], times)]
    video = replace(video, cameras=tuple(turned))
    evidence = TrackEvidence(simulation, video, match(simulation, video, states))
    for k in range(len(times)):  # the simulation is the truth
        off = evidence.residuals(simulation, [states[k]], k)[0][0].median(0).values
        assert off.tolist() == pytest.approx([0.0, 0.0], abs=0.05)
