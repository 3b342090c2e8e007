import math

import numpy as np
import pytest
import torch
from shared import EYE, double, value_error
from small_captures import write_colmap, write_transforms
from small_scenes import guess, plain_cloud
from things import full

from gaussian_swaying.captures.capture_camera import photo_azimuth
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.suggestion.moves import backdrops, cameras_up, read_photos, seen_share, shown_object

TILT = torch.linalg.qr(double([[1.0, 0.2, 0.1], [0.0, 1.0, -0.4], [0.3, 0.0, 1.0]]))[0]
TILT = TILT * torch.linalg.det(TILT)  # a rotation


def cameras(eyes, target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), roll=0.0, turn=None):
    made = []
    for k, eye in enumerate(eyes):
        camera = look_at_camera(list(eye), list(target), list(up), 50.0, 64, 48, dtype=torch.float64)
        angle = math.radians(roll) * (1 if k % 2 else -1)
        about = torch.eye(4).double()
        about[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        view = about @ camera.world_to_camera
        if turn is not None:
            back = torch.eye(4).double()
            back[:3, :3] = turn.T
            view = view @ back
        made.append(type(camera)(view, camera.intrinsics, camera.width, camera.height))
    return made


def ring(count=12, radius=4.0, height=1.0, first=0.0, last=360.0):
    angles = [math.radians(first + (last - first) * k / count) for k in range(count)]
    return [(radius * math.cos(a), radius * math.sin(a), height) for a in angles]


def write_capture(folder, made):
    return write_transforms(folder, made, [f"{k:03d}.png" for k in range(len(made))], images=False)


def room():
    """A trophy (0.6 x 0.5 x 0.9) on the wall x = 0, a wall wider than the photos, and a room behind the cameras."""
    trophy = torch.cat([full([0.03, -0.3, -0.4], [0.6, 0.2, 0.4], 2500), full([0.4, -0.2, 0.3], [0.6, 0.1, 0.5], 300)])
    wall = full([-0.03, -4.0, -4.0], [0.03, 4.0, 4.0], 12000, 1)
    clutter = full([-1.0, -12.0, -8.0], [14.0, 12.0, 8.0], 1500, 2)
    clutter = clutter[(clutter[:, 0] > 6) | (clutter[:, 1].abs() > 6)]
    return trophy, torch.cat([trophy, wall, clutter])


# ---- up


def test_level_photos_tell_up_whatever_their_pitch():
    made = cameras(ring(9, 3.0, 3.0, -60, 60))
    up = cameras_up(made)
    assert (up.direction, up.confidence) == ((0, 0, 1), "high")
    assert "held level to 0.0 degrees" in up.reasons[0]
    tilted = cameras_up(cameras(ring(9, 3.0, 3.0, -60, 60), turn=TILT))
    assert list(tilted.direction) == pytest.approx(TILT[:, 2].tolist(), abs=1e-6)
    assert tilted.confidence == "high"


def test_up_of_photos_that_were_held_askew():
    """Rolled by 5 degrees to both sides in turn; by 60, and nothing is sure any more; all the same way."""
    up = cameras_up(cameras(ring(), roll=5))
    assert (up.direction, up.confidence) == ((0, 0, 1), "high")
    assert cameras_up(cameras(ring(height=0.2), roll=60)).confidence == "low"
    up = cameras_up(cameras([(3.0, 0.01 * k, 0.0) for k in range(5)]))
    assert (up.direction, up.confidence) == ((0, 0, 1), "medium")
    assert "mean" in up.reasons[0]


def test_up_of_photos_beats_the_shape(tmp_path):
    """A sheet in the plane x-z: convention and shape say y down, the cameras say z up."""
    flag = plain_cloud(full([0.0, -0.002, 0.0], [1.6, 0.002, 0.7], 1500))
    capture = write_capture(tmp_path / "a", cameras(ring(), (0.8, 0.0, 0.35)))
    found = guess(flag, capture=capture)
    assert (found.up.direction, found.up.confidence) == ((0, 0, 1), "high")
    assert found.moving.simulated.sum() == 1500  # a sheet is no backdrop of itself
    assert found.hold.name != "bottom"
    assert guess(flag, up="+x", capture=capture).up.confidence == "given"


# ---- what photos show


def test_share_of_photos_is_that_of_the_pictures():
    made = cameras([(4.0, 0.0, 0.0), (-4.0, 0.0, 0.0)])
    points = torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [0.0, 0, 9.0], [0.0, 1.8, 1.8]])
    half = 4 * math.tan(math.radians(25))
    assert half == pytest.approx(1.865, abs=1e-3)  # up and down; 4/3 of it to the sides
    assert seen_share(points.numpy(), made).tolist() == [1.0, 0.5, 0.0, 1.0]


def test_wall_and_room_are_left_out(tmp_path):
    trophy, everything = room()
    capture = write_capture(tmp_path / "a", cameras(ring(14, 3.0, 0.5, -50, 50), (0.2, 0.0, 0.0)))
    assert read_photos(capture).focus.tolist() == pytest.approx([0.2, 0, 0], abs=1e-4)
    found = guess(plain_cloud(everything), capture=capture)
    simulated = found.moving.simulated
    assert simulated[: len(trophy)].mean() > 0.85  # what is nearest to the wall is taken for it
    assert simulated[len(trophy) :].sum() < 0.05 * len(trophy)
    assert np.array_equal(found.moving.region.contains(everything), simulated)  # the YAML picks the same
    assert (found.hold.name, found.hold.confidence) == ("side", "medium")
    assert found.hold.direction[0] < -0.98
    held = everything[found.pin.contains(everything).numpy() & simulated]
    assert 0 < held[:, 0].max() < 0.3
    assert abs(found.azimuth) < 10  # seen from where the photos were taken, not through the wall
    assert found.flow[1] == pytest.approx(3.0, abs=0.25)  # across the picture
    alone = guess(plain_cloud(everything))  # without cameras it takes in the room
    assert alone.moving.simulated.sum() > 2 * simulated.sum()


def test_floor_under_what_photos_show_holds_it(tmp_path):
    """Tilted by some 30 degrees to all axes, which no rule on axes finds."""
    plant = torch.cat([full([-0.1, -0.1, 0.0], [0.1, 0.1, 0.5], 800), full([-0.3, -0.3, 0.5], [0.3, 0.3, 1.0], 2000)])
    floor = full([-4.0, -4.0, -0.05], [4.0, 4.0, 0.0], 9000, 1)
    means = torch.cat([plant, floor]).double() @ TILT.T
    capture = write_capture(tmp_path / "a", cameras(ring(16, 3.0, 1.5), (0.0, 0.0, 0.4), turn=TILT))
    found = guess(plain_cloud(means), capture=capture)
    assert list(found.up.direction) == pytest.approx(TILT[:, 2].tolist(), abs=1e-5)
    assert found.ground[len(plant) :].mean() > 0.95
    assert found.moving.simulated[: len(plant)].mean() > 0.85
    assert not found.moving.simulated[len(plant) :].any()
    assert (found.hold.name, found.hold.confidence) == ("bottom", "high")
    assert "what was left out touches its lower end" in found.hold.reasons[0]
    eyes = torch.from_numpy(read_photos(capture).eyes)  # all around
    assert photo_azimuth(eyes, torch.zeros(3), EYE) is None


def test_what_is_no_backdrop():
    eyes = np.array(ring(12, 3.0, 0.5, -50, 50))
    wall = full([-0.03, -4.0, -4.0], [0.03, 4.0, 4.0], 4000)
    head = full([0.1, -0.5, -0.5], [0.8, 0.5, 0.5], 1000)

    def found(*parts, eyes=eyes):
        points = torch.cat(parts).double().numpy()
        return backdrops(points, np.ones(len(points)), eyes, 2.0, 0.05)

    (one,) = found(wall, head)
    assert one.normal[0] > 0.99
    assert one.behind.contains(torch.tensor([-1.0, 0.5, 0.5]))
    assert not one.behind.contains(torch.tensor([0.6, 0.0, 0.0]))
    assert found(wall) == []  # nothing in front: a sheet
    assert found(wall * torch.tensor([1.0, 0.15, 0.15]), head) == []  # no wider than what is before it
    both = np.concatenate([eyes, eyes * [-1.0, 1, 1]])
    assert found(wall, head, eyes=both) == []  # cameras on both sides


def test_cameras_that_look_elsewhere_are_refused(tmp_path):
    everything = Gaussians.of(plain_cloud(room()[1]))
    away = write_capture(tmp_path / "away", cameras(ring(9, 2.0), (0.0, 0.0, 900.0)))
    side = write_capture(tmp_path / "side", cameras([(float(k), 0.0, 0.0) for k in range(3)], (1e7, 0.0, 0.0)))
    for folder, words in ((away, "splat has 0 Gaussians"), (side, "do not look at a common point.*set `--region`")):
        with value_error(words):
            shown_object(everything, read_photos(folder))


def test_a_colmap_model_tells_the_same(tmp_path):
    made = cameras(ring(10, 3.0, 1.0), turn=TILT)
    names = [f"{k}.png" for k in range(len(made))]
    colmap = write_colmap(tmp_path / "colmap", made, names, binary=False, images=False)
    one, other = read_photos(colmap), read_photos(write_capture(tmp_path / "json", made))
    assert list(one.up.direction) == pytest.approx(list(other.up.direction), abs=1e-5)
    assert one.focus.tolist() == pytest.approx(other.focus.tolist(), abs=1e-4)
    assert one.reach == pytest.approx(other.reach, rel=1e-4)
