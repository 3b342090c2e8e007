from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from shared import alike, near, peak, user_warning, value_error
from small_captures import arc, write_colmap, write_transforms

from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.captures.initial_points import consistent_points, initial_points, random_points


@pytest.fixture
def capture(tmp_path):
    names = [f"images/{index}.png" for index in range(4)]
    return read_capture(write_transforms(tmp_path / "capture", arc(4), names), test_every=0)


def test_points_of_the_capture_come_first(tmp_path):
    capture = read_capture(write_colmap(tmp_path, arc(2), ["a.png", "b.png"]), test_every=0)
    for source in ("auto", "capture"):
        assert torch.equal(initial_points(capture, source).points, capture.points)
    assert len(initial_points(capture, "random", count=50)) == 50


def test_random_points_fill_what_the_cameras_see(capture):
    """The cameras stand 2 to 2.02 from (0, 0, 0.2); their wider half field of view has tan 10/8 tan(25 degrees)."""
    cloud = initial_points(capture, "auto", count=20_000, seed=3)
    reach = 2.0 * 10 / 8 * np.tan(np.radians(25))
    middle = 0.5 * (cloud.points.amax(0) + cloud.points.amin(0))
    near(middle, torch.tensor([0.0, 0.0, 0.2]), 0.01)
    alike(cloud.points.amax(0) - middle, torch.full((3,), reach).float(), 0.02)
    assert 0 <= cloud.colors.min() < 0.01 < 0.99 < cloud.colors.max() <= 1
    assert torch.equal(initial_points(capture, count=20_000, seed=3).points, cloud.points)
    assert not torch.equal(initial_points(capture, count=20_000, seed=4).points, cloud.points)
    small = initial_points(capture, half_side=0.1, count=100)
    assert peak(small.points - torch.tensor([0.0, 0.0, 0.2])) <= 0.1 + 1e-6


def test_random_points_keep_away_from_the_cameras(capture):
    """Half a camera's distance, also where the cube holds the cameras; all of the rest is filled."""
    middle = torch.tensor([0.0, 0.0, 0.2])
    cloud = initial_points(capture, "random", count=20_000, half_side=4.0)
    assert len(cloud) == 20_000
    eyes = torch.stack([view.camera.position for view in capture.views])
    ratio = torch.cdist(cloud.points, eyes) / (eyes - middle).norm(dim=-1)
    assert 0.5 <= ratio.min() < 0.53
    reach = (cloud.points - middle).abs().amax(0)
    alike(reach, torch.full((3,), 4.0), 0.01)


def test_random_points_without_room(capture, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.captures.initial_points._ATTEMPTS", 1)
    with value_error("leave no room"):
        initial_points(capture, "random", count=1000, half_side=4.0)


def test_consistent_points_lie_where_the_photos_agree(tmp_path):
    """Of points around a flag seen from all sides, those near it; the mean of their colours is the flag's there."""
    flag = GeneratedCapture(views=24, size=48)
    capture = read_capture(flag.write(tmp_path / "flag"))
    chosen = consistent_points(capture, 400, seed=1, half_side=0.9)
    assert len(chosen) == 400
    around = random_points(torch.tensor([0.6, 0.0, 0.4]), 0.9, 400)
    off_black = chosen.colors.sum(-1) > 0.2  # the background is black in all photos: consistent too
    assert torch.equal(consistent_points(capture, 400, seed=1, half_side=0.9).points, chosen.points)

    x, z = torch.cartesian_prod(torch.linspace(0, 1.2, 121), torch.linspace(0, 0.8, 81)).T
    sheet = torch.stack([x, flag.elevation(x, z), z], -1)

    def typical(points):
        return float(torch.cdist(points, sheet).amin(-1).median())

    assert off_black.any()
    assert typical(chosen.points[off_black]) < 0.5 * typical(around.points)
    cause = "in fewer than three of the 21 training photos.*cameras overlap too little.*`point_count`"
    with value_error(cause):
        consistent_points(capture, 400, half_side=1e3)
    few = replace(capture, views=capture.split("train")[:2])
    with value_error(r"100% are in fewer than three of the 2 .*too few photos \(`test_every`\)"):
        consistent_points(few, 400)


def test_points_of_a_ply(tmp_path, capture):
    rows = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], dtype=[(n, "<f4") for n in "xyz"])
    points = PlyElement.describe(rows, "vertex")
    PlyData([points]).write(str(tmp_path / "points.ply"))
    cloud = initial_points(capture, str(tmp_path / "points.ply"), count=7)
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert cloud.colors.unique().tolist() == [0.5]


def test_bad_sources_are_named(tmp_path, capture):
    with value_error("has no points"):
        initial_points(capture, "capture")
    with value_error(r"points\.xyz.*a \.ply file"):
        initial_points(capture, "points.xyz")
    with value_error(r"none\.ply.*check the path"):
        initial_points(capture, tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("hello")
    with value_error(r"text\.ply is not a \.ply"):
        initial_points(capture, tmp_path / "text.ply")
    with value_error("`count`"):
        initial_points(capture, count=0)
    with value_error("`half_side`"):
        random_points(torch.zeros(3), 0.0, 5)


def test_cameras_that_look_apart_need_points(tmp_path):
    from gaussian_swaying.rendering.cameras.camera import look_at_camera

    eyes = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    outward = [look_at_camera(eye, [2 * v for v in eye], (0, 0, 1), 40.0, 20, 16, dtype=torch.float64) for eye in eyes]
    folder = write_transforms(tmp_path, outward, [f"{i}.png" for i in range(4)])
    with user_warning("axes meet behind the cameras"):
        capture = read_capture(folder, test_every=0)
    with value_error("look at no common point, but away from one"):
        initial_points(capture)
