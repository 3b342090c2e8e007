"""What cameras tell about a splat: up, the object, a wall or floor behind it."""

import math

import pytest
import torch
from shared import refused
from small_captures import write_colmap, write_transforms
from small_scenes import plain_cloud

from gaussian_swaying.captures.capture_camera import photo_azimuth
from gaussian_swaying.cli.preview import main
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.preview.photos import (
    Backdrop,
    CapturedFrom,
    backdrops,
    cameras_up,
    captured_from,
    looked_at,
    seen_share,
)
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.rendering.cameras.camera import look_at_camera

TILT = torch.linalg.qr(torch.tensor([[1.0, 0.2, 0.1], [0.0, 1.0, -0.4], [0.3, 0.0, 1.0]], dtype=torch.float64))[0]
TILT = TILT * torch.linalg.det(TILT)  # a rotation


def cameras(eyes, target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), roll=0.0, turn=None):
    """Cameras that look at a point, each rolled about its axis, all of them turned."""
    made = []
    for k, eye in enumerate(eyes):
        camera = look_at_camera(list(eye), list(target), list(up), 50.0, 64, 48, dtype=torch.float64)
        angle = math.radians(roll) * (1 if k % 2 else -1)
        about = torch.eye(4, dtype=torch.float64)
        about[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        view = about @ camera.world_to_camera
        if turn is not None:
            back = torch.eye(4, dtype=torch.float64)
            back[:3, :3] = turn.T
            view = view @ back
        made.append(type(camera)(view, camera.intrinsics, camera.width, camera.height))
    return made


def ring(count=12, radius=4.0, height=1.0, first=0.0, last=360.0):
    """Places on an arc about z."""
    angles = [math.radians(first + (last - first) * k / count) for k in range(count)]
    return [(radius * math.cos(a), radius * math.sin(a), height) for a in angles]


def write_capture(folder, made):
    """A transforms.json without images."""
    return write_transforms(folder, made, [f"{k:03d}.png" for k in range(len(made))], images=False)


def uniform(low, high, count, seed=0):
    draw = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(low), torch.tensor(high)
    return low + torch.rand(count, 3, generator=draw) * (high - low)


def room():
    """A trophy (0.6 x 0.5 x 0.9) on the wall x = 0, a wall wider than the photos, and a room behind the cameras."""
    trophy = torch.cat(
        [uniform([0.03, -0.3, -0.4], [0.6, 0.2, 0.4], 2500), uniform([0.4, -0.2, 0.3], [0.6, 0.1, 0.5], 300)]
    )
    wall = uniform([-0.03, -4.0, -4.0], [0.03, 4.0, 4.0], 12000, 1)
    clutter = uniform([-1.0, -12.0, -8.0], [14.0, 12.0, 8.0], 1500, 2)
    clutter = clutter[(clutter[:, 0] > 6) | (clutter[:, 1].abs() > 6)]
    return trophy, torch.cat([trophy, wall, clutter])


# ---- up


def test_level_photos_tell_up_whatever_their_pitch():
    """All from one side and from above: the mean of their upward directions leans away, their rows do not."""
    made = cameras(ring(9, 3.0, 3.0, -60, 60))
    up, confidence, reason = cameras_up(made)
    assert up == (0, 0, 1)
    assert confidence == "high"
    assert "held level to 0.0 degrees" in reason
    tilted, confidence, _ = cameras_up(cameras(ring(9, 3.0, 3.0, -60, 60), turn=TILT))
    assert list(tilted) == pytest.approx((TILT @ torch.tensor([0.0, 0, 1]).double()).tolist(), abs=1e-6)
    assert confidence == "high"


def test_up_of_photos_that_were_held_askew():
    """Rolled by 5 degrees to both sides in turn; by 60, and nothing is sure any more; all the same way."""
    up, confidence, _ = cameras_up(cameras(ring(), roll=5))
    assert (up, confidence) == ((0, 0, 1), "high")
    assert cameras_up(cameras(ring(height=0.2), roll=60))[1] == "low"
    up, confidence, reason = cameras_up(cameras([(3.0, 0.01 * k, 0.0) for k in range(5)]))
    assert (up, confidence) == ((0, 0, 1), "medium")
    assert "mean" in reason


def test_up_of_photos_beats_the_shape(tmp_path):
    """A sheet in the plane x-z: convention and shape say y down, the cameras say z up."""
    flag = plain_cloud(uniform([0.0, -0.002, 0.0], [1.6, 0.002, 0.7], 1500))
    view = captured_from(write_capture(tmp_path / "a", cameras(ring(), (0.8, 0.0, 0.35))))
    found = suggest(flag, capture=view)
    assert found.up.direction == (0, 0, 1)
    assert found.up.confidence == "high"
    assert int(found.region.simulated.sum()) == 1500  # a sheet is no backdrop of itself
    assert found.hold.end != "bottom"
    assert suggest(flag, up="+x", capture=view).up.confidence == "given"


# ---- what photos show


def test_share_of_photos_is_that_of_the_pictures():
    made = cameras([(4.0, 0.0, 0.0), (-4.0, 0.0, 0.0)])
    points = torch.tensor([[0.0, 0, 0], [5.0, 0, 0], [0.0, 0, 9.0], [0.0, 1.8, 1.8]])
    half = 4 * math.tan(math.radians(25))
    assert half == pytest.approx(1.865, abs=1e-3)  # up and down; 4/3 of it to the sides
    assert seen_share(points, made).tolist() == [1.0, 0.5, 0.0, 1.0]


def test_wall_and_room_are_left_out(tmp_path):
    trophy, everything = room()
    view = captured_from(write_capture(tmp_path / "a", cameras(ring(14, 3.0, 0.5, -50, 50), (0.2, 0.0, 0.0))))
    assert view.focus.tolist() == pytest.approx([0.2, 0, 0], abs=1e-4)
    found = suggest(plain_cloud(everything), capture=view)
    simulated = found.region.simulated
    inside = simulated[: len(trophy)]
    assert float(inside.double().mean()) > 0.85  # what is nearest to the wall is taken for it
    assert int(simulated[len(trophy) :].sum()) < 0.05 * len(trophy)
    region = found.region.region()
    assert torch.equal(region.contains(plain_cloud(everything).means), simulated)  # the YAML picks what is said
    assert (found.hold.end, found.hold.confidence) == ("side", "medium")
    assert found.hold.direction[0] < -0.98
    held = found.pin.contains(everything) & simulated
    assert 0 < float(everything[held][:, 0].max()) < 0.3
    assert abs(found.azimuth) < 10  # seen from where the photos were taken, not through the wall
    assert found.flow[1] == pytest.approx(3.0, abs=0.25)  # across the picture
    alone = suggest(plain_cloud(everything))  # without cameras it takes in the room
    assert int(alone.region.simulated.sum()) > 2 * int(simulated.sum())


def test_floor_under_what_photos_show_holds_it(tmp_path):
    """Tilted by some 30 degrees to all axes, which no rule on axes finds."""
    plant = torch.cat(
        [uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.5], 800), uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.0], 2000)]
    )
    floor = uniform([-4.0, -4.0, -0.05], [4.0, 4.0, 0.0], 9000, 1)
    means = torch.cat([plant, floor]).double() @ TILT.T
    view = captured_from(write_capture(tmp_path / "a", cameras(ring(16, 3.0, 1.5), (0.0, 0.0, 0.4), turn=TILT)))
    found = suggest(plain_cloud(means), capture=view)
    assert list(found.up.direction) == pytest.approx((TILT @ torch.tensor([0.0, 0, 1]).double()).tolist(), abs=1e-5)
    assert float(found.up.ground[len(plant) :].double().mean()) > 0.95
    assert float(found.region.simulated[: len(plant)].double().mean()) > 0.85
    assert int(found.region.simulated[len(plant) :].sum()) == 0
    assert (found.hold.end, found.hold.confidence) == ("bottom", "high")
    assert "what was left out touches its lower end" in found.hold.reason
    assert photo_azimuth(view.eyes, torch.zeros(3), torch.eye(3, dtype=torch.float64)) is None  # from all around


def test_what_is_no_backdrop():
    eyes = torch.tensor(ring(12, 3.0, 0.5, -50, 50))
    wall = uniform([-0.03, -4.0, -4.0], [0.03, 4.0, 4.0], 4000)
    head = uniform([0.1, -0.5, -0.5], [0.8, 0.5, 0.5], 1000)

    def found(*parts, eyes=eyes):
        points = torch.cat(parts)
        return backdrops(points, torch.ones(len(points)), eyes, 2.0, 0.05)

    (one,) = found(wall, head)
    assert isinstance(one, Backdrop)
    assert one.normal[0] > 0.99
    assert bool(one.behind.contains(torch.tensor([-1.0, 0.5, 0.5])))
    assert not bool(one.behind.contains(torch.tensor([0.6, 0.0, 0.0])))
    assert found(wall) == []  # nothing in front: a sheet
    assert found(wall * torch.tensor([1.0, 0.15, 0.15]), head) == []  # no wider than what is before it
    both = torch.cat([eyes, eyes * torch.tensor([-1.0, 1, 1])])
    assert found(wall, head, eyes=both) == []  # cameras on both sides


def test_cameras_that_look_elsewhere_are_refused(tmp_path, capsys):
    _, everything = room()
    splat = tmp_path / "room.ply"
    write_ply(splat, plain_cloud(everything))
    away = write_capture(tmp_path / "away", cameras(ring(9, 2.0), (0.0, 0.0, 900.0)))
    side = write_capture(tmp_path / "side", cameras([(float(k), 0.0, 0.0) for k in range(3)], (1e7, 0.0, 0.0)))
    for folder, words in (
        (away, "splat has 0 Gaussians"),
        (side, "do not look at a common point"),
        (tmp_path / "no", "no"),
    ):
        arguments = [str(splat), "--capture", str(folder), "--output", str(tmp_path / "out"), "--device", "cpu"]
        refused(main, arguments, capsys, words, folder=tmp_path)
    view = captured_from(side)
    assert view.focus is None
    with pytest.raises(ValueError, match="set `--region`"):
        looked_at(everything, view)


def test_a_colmap_model_tells_the_same(tmp_path):
    made = cameras(ring(10, 3.0, 1.0), turn=TILT)
    names = [f"{k}.png" for k in range(len(made))]
    colmap = write_colmap(tmp_path / "colmap", made, names, binary=False, images=False)
    one, other = captured_from(colmap), captured_from(write_capture(tmp_path / "json", made))
    assert isinstance(one, CapturedFrom)
    assert list(one.up) == pytest.approx(list(other.up), abs=1e-5)
    assert one.focus.tolist() == pytest.approx(other.focus.tolist(), abs=1e-4)
    assert one.reach == pytest.approx(other.reach, rel=1e-4)
