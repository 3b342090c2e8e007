import math
from itertools import pairwise

import pytest
import torch
from shared import double, value_error

from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.rendering.cameras.keyframes import CameraKey, interpolate_keys

CENTER, UP = torch.zeros(3).double(), double([0.0, 0.0, 1.0])
TIMES = [0.0, 1.0, 1.5, 4.0]
ROWS = [[0.0, 5.0], [2.0, -1.0], [3.0, 4.0], [3.0, 6.0]]


def test_keys_are_met_and_held_beyond():
    for time, row in zip(TIMES, ROWS, strict=True):
        assert interpolate_keys(TIMES, ROWS, time) == pytest.approx(row)
    assert interpolate_keys(TIMES, ROWS, -3.0) == ROWS[0]
    assert interpolate_keys(TIMES, ROWS, 9.0) == ROWS[-1]


def test_smooth_values_stay_between_their_keys_and_have_no_kink():
    for k in range(3):
        for d in range(2):
            low, high = sorted((ROWS[k][d], ROWS[k + 1][d]))
            steps = [TIMES[k] + s / 50 * (TIMES[k + 1] - TIMES[k]) for s in range(51)]
            values = [interpolate_keys(TIMES, ROWS, t)[d] for t in steps]
            assert all(low - 1e-12 <= value <= high + 1e-12 for value in values)
            differences = [b - a for a, b in pairwise(values)]
            assert all(x >= -1e-12 for x in differences) or all(x <= 1e-12 for x in differences)
    h = 1e-5  # the second derivative is below 100 here, so one-sided differences are off by less than 1e-3
    for time in TIMES:
        before, now, after = (interpolate_keys(TIMES, ROWS, time + x) for x in (-h, 0.0, h))
        rates = [((n - b) / h, (a - n) / h) for b, n, a in zip(before, now, after, strict=True)]
        for left, right in rates:
            assert left == pytest.approx(right, abs=2e-3)
    rising = [interpolate_keys(TIMES, ROWS, 1.0 + x)[0] for x in (-h, h)]
    assert (rising[1] - rising[0]) / (2 * h) > 1.0  # no stop at a key that is passed


def test_two_smooth_keys_are_a_smoothstep():
    for s in (0.25, 0.5, 0.8):
        assert interpolate_keys([1.0, 3.0], [[0.0], [1.0]], 1 + 2 * s)[0] == pytest.approx(s * s * (3 - 2 * s))


def test_angles_are_those_of_the_orbit():
    """At a key the camera of OrbitCamera; what a key leaves out stays; a target of its own moves the sphere."""
    keys = [
        CameraKey(0.0, azimuth=-90.0, elevation=10.0, radius=2.0),
        CameraKey(2.0, azimuth=270.0, fov_y=30.0),
        CameraKey(3.0, target=[1.0, 0.0, 0.0]),
    ]
    path = LookAtCamera(keys=keys, width=32, height=18)
    start = OrbitCamera(32, 18, azimuth=-90.0, elevation=10.0, radius=2.0)(0, 0.0, CENTER, UP, 1.5)
    torch.testing.assert_close(path(0, 0.0, CENTER, UP, 1.5).world_to_camera, start.world_to_camera)
    half = OrbitCamera(32, 18, fov_y=35.0, azimuth=90.0, elevation=10.0, radius=2.0)(0, 0.0, CENTER, UP, 1.5)
    camera = path(25, 1.0, CENTER, UP, 1.5)
    torch.testing.assert_close(camera.world_to_camera, half.world_to_camera)
    torch.testing.assert_close(camera.intrinsics, half.intrinsics)
    end = path(75, 3.0, CENTER, UP, 1.5)
    assert float((end.position - torch.tensor([1.0, 0.0, 0.0])).norm()) == pytest.approx(3.0)
    assert float(end.intrinsics[1, 1]) == pytest.approx(9 / math.tan(math.radians(15.0)))


def test_eyes_look_at_their_targets():
    keys = [CameraKey(0.0, eye=[0.0, -3.0, 0.0]), CameraKey(1.0, eye=[2.0, -3.0, 1.0], target=[0.0, 0.0, 1.0])]
    path = LookAtCamera(keys=keys, width=32, height=18)
    found = path(0, 0.5, CENTER, UP, 1.0)
    expected = look_at_camera([1.0, -3.0, 0.5], [0.0, 0.0, 0.5], UP, 40.0, 32, 18, dtype=torch.float64)
    torch.testing.assert_close(found.world_to_camera, expected.world_to_camera)
    lying = LookAtCamera(keys=keys, up=[1.0, 0.0, 0.0], width=32, height=18)(0, 0.0, CENTER, UP, 1.0)
    torch.testing.assert_close(lying.world_to_camera[1, :3], double([-1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ([], "at least one key"),
        ([CameraKey(0.0)], "neither"),
        ([CameraKey(0.0, eye=[1, 2, 3], radius=1.0)], "both"),
        ([CameraKey(0.0, azimuth=0.0, radius=1.0)], "has no `elevation`"),
        ([CameraKey(0.0, azimuth=0.0, elevation=90.0, radius=1.0)], "`keys.elevation`"),
        ([CameraKey(0.0, azimuth=0.0, elevation=0.0, radius=0.0)], "`keys.radius`"),
        ([CameraKey(1.0, eye=[0, 1, 2]), CameraKey(1.0, eye=[0, 1, 3])], "to increase"),
        ([CameraKey(0.0, eye=[0, 1])], "`keys.eye` to have 3 numbers"),
    ],
)
def test_bad_keys(keys, words):
    with value_error(words):
        LookAtCamera(keys=keys)
