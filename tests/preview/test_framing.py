"""Cameras that show the whole object, and coordinates on the preview's box."""

import math

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFont
from small_scenes import plain_cloud, started, together

from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.preview.framing import RADIUS, orbit_frame, whole_box
from gaussian_swaying.preview.picture import _whole
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.preview.ticks import COLOUR, draw_ticks, nice_ticks
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import classify


def column(count=3000, side=0.3, height=2.0):
    """A square column on the origin, z up."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    return (points - torch.tensor([0.5, 0.5, 0.0])) * torch.tensor([side, side, height])


# ---- ticks


@pytest.mark.parametrize(
    ("low", "high", "most", "ticks", "decimals"),
    [
        (-3.18, 0.0, 5, [-3, -2, -1, 0], 0),
        (0.013, 0.062, 6, [0.02, 0.03, 0.04, 0.05, 0.06], 2),
        (-0.4, 0.4, 3, [0.0], 1),
        (-250.0, 730.0, 5, [-200, 0, 200, 400, 600], 0),
        (0.0, 0.0, 5, [], 0),
    ],
)
def test_ticks_are_round_and_few(low, high, most, ticks, decimals):
    values, places = nice_ticks(low, high, most)
    if (low, high) == (-0.4, 0.4):
        assert len(values) <= most
        assert 0.0 in values
        return
    assert values == ticks
    assert places == decimals


def test_ticks_stand_where_their_coordinates_are():
    camera = look_at_camera([1.5, -6.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 40.0, 480, 480)
    page = Image.new("RGB", (480, 480), (255, 255, 255))
    low, high = [-0.7, -0.7, -1.3], [0.7, 0.7, 1.3]
    draw_ticks(ImageDraw.Draw(page), ImageFont.load_default(size=14), low, high, camera)
    pixels = np.asarray(page).astype(int)

    def marked(point):
        x, y = project(torch.tensor([point]), camera)[0][0].round().int().tolist()
        near = np.abs(pixels[y - 2 : y + 3, x - 2 : x + 3] - np.array(COLOUR)).sum(-1)
        return bool((near < 30).any())

    # the rightmost upright edge and the lowest edge along x; y is seen from its end
    assert all(marked([0.7, 0.7, value]) for value in (-1.0, -0.5, 0.0, 0.5, 1.0))
    assert not marked([0.7, 0.7, 0.25])
    assert all(marked([value, -0.7, -1.3]) for value in (-0.5, 0.0, 0.5))
    assert not any(marked([-0.7, value, -1.3]) for value in (-0.5, 0.0, 0.5))
    away = look_at_camera([0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 40.0, 480, 480)
    before = np.asarray(page).copy()
    draw_ticks(ImageDraw.Draw(page), ImageFont.load_default(), [-1, -3, -1], [1, -1, 1], away)  # behind the eye
    assert np.array_equal(np.asarray(page), before)


# ---- the whole object


def test_whole_object_has_what_does_not_move_and_no_floor_nor_specks():
    body = column()
    floor = column(4000, 6.0, 0.001) - torch.tensor([0.0, 0.0, 0.02])
    speck = torch.tensor([[0.8, 0.8, 0.3]]).repeat(5, 1)
    points = torch.cat([body, floor, speck])
    opacity = torch.full((len(points),), 0.9)
    moving = torch.zeros(len(points), dtype=torch.bool)
    moving[:3000] = body[:, 2] > 1.2
    outside = torch.zeros_like(moving)
    outside[3000:7000] = True
    low, high = whole_box(points, opacity, moving, outside, 0.06)
    assert low == pytest.approx([-0.15, -0.15, 0.4], abs=0.01)  # a longest side of 0.8 m below what moves
    assert high == pytest.approx([0.15, 0.15, 2.0], abs=0.01)
    moving[:3000] = body[:, 2] > 0.8
    assert whole_box(points, opacity, moving, outside, 0.06)[0][2] == pytest.approx(0.0, abs=0.01)
    opacity[:3000][body[:, 2] < 0.8] = 0.01  # haze is no object
    assert whole_box(points, opacity, moving, outside, 0.06)[0][2] == pytest.approx(0.8, abs=0.01)


def test_camera_of_the_starter_shows_all_of_it(tmp_path):
    cloud = plain_cloud(column())
    for region, below in ((None, 0.0), (([-1.0, -1.0, 1.1], [1.0, 1.0, 3.0]), 0.2)):
        found = suggest(cloud, "+z", region=region)
        assert found.whole[0][2] == pytest.approx(below, abs=0.05)
        simulation = started(found, cloud, tmp_path)
        camera = simulation.painter.camera_at(0)
        shown = cloud.means[cloud.means[:, 2] >= below]
        pixel, depth = project(shown, camera)
        assert float(depth.min()) > 0
        edge = torch.tensor([camera.width, camera.height]) - pixel
        assert float(torch.minimum(pixel, edge).min()) > 0.05 * camera.height  # room to sway
        assert float(pixel[:, 1].amax() - pixel[:, 1].amin()) > 0.5 * camera.height  # and yet large
        low, _ = _whole(simulation, classify(simulation))  # as a preview of this configuration has it
        assert low == pytest.approx(found.whole[0], abs=0.05)


def test_orbit_is_left_alone_where_all_of_it_moves():
    box = ([0.0, 0.0, 0.0], [1.0, 1.0, 2.0])
    assert orbit_frame(box, box) == ((0, 0, 0), RADIUS)
    offset, radius = orbit_frame(([0.0, 0.0, -2.0], [1.0, 1.0, 2.0]), box)
    assert offset == (0, 0, -0.5)
    assert radius == pytest.approx(2 * RADIUS)


def test_floor_is_not_framed(make_simulation):
    """A flag over a floor that stays: the picture is that of the flag."""
    flag = FlagScene(spacing=0.1).generate()
    side = torch.arange(-3, 3.01, 0.1)
    x, y = torch.meshgrid(side, side, indexing="ij")
    floor = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), -0.1)], -1)
    cloud = together(flag, plain_cloud(floor, torch.tensor([0.08, 0.08, 0.001]).log()))
    simulation = make_simulation(cloud=cloud, scene={"region": Box([None, None, 0.0], [None, None, None])})
    low, high = _whole(simulation, classify(simulation))
    assert low == pytest.approx(flag.means.amin(0).tolist(), abs=1e-5)
    assert high == pytest.approx(flag.means.amax(0).tolist(), abs=1e-5)
    assert math.isfinite(sum(low))
