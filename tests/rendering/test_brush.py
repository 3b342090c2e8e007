import itertools
import math

import pytest
import torch
from shared import seeded

from gaussian_swaying.rendering.brush import REACH, SOLID, seen, touched
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.rendering.torch_renderer import render_torch


def _camera(width=120, height=90, eye=(0.0, -3.0, 0.0)):
    return look_at_camera(eye, (0, 0, 0), (0, 0, 1), 40.0, width, height, dtype=torch.float64)


def _view(means, sigma=0.03, opacity=0.95, camera=None, small=None, slack=0.0):
    camera = camera or _camera()
    covariances = sigma**2 * torch.eye(3).expand(len(means), 3, 3)
    picture = render_torch(
        means, covariances, torch.full((len(means),), opacity), torch.zeros_like(means), small or camera
    )
    return seen(means, covariances, camera, picture, slack)


def _sheet(y, count=24):
    x, z = torch.meshgrid(*[torch.linspace(-0.6, 0.6, count)] * 2, indexing="ij")
    return torch.stack([x, torch.full_like(x, y), z], -1).reshape(-1, 3)


def _distance(x, y, path):
    ends = [*itertools.pairwise(path)] or [(path[0], path[0])]
    found = []
    for (ax, ay), (bx, by) in ends:
        length = (bx - ax) ** 2 + (by - ay) ** 2
        t = 0.0 if length == 0 else min(1.0, max(0.0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length))
        found.append(math.hypot(x - ax - t * (bx - ax), y - ay - t * (by - ay)))
    return min(found)


def _slope(depth, row, column):
    total = 0.0
    for down, right in ((1, 0), (0, 1)):
        steps = []
        for side in (-1, 1):
            r, c = row + side * down, column + side * right
            if 0 <= r < len(depth) and 0 <= c < len(depth[0]) and math.isfinite(depth[r][c] - depth[row][column]):
                steps.append(abs(depth[r][c] - depth[row][column]))
        total += min(steps, default=0.0) ** 2
    return math.sqrt(total)


PATHS = {
    "a dab": [[40.0, 50.0]],
    "a dab twice": [[40.0, 50.0], [40.0, 50.0]],
    "a line": [[10.0, 20.0], [90.0, 60.0]],
    "a path that crosses itself": [[20.0, 20.0], [100.0, 70.0], [100.0, 20.0], [20.0, 70.0]],
    "beside the picture": [[-50.0, -50.0], [-20.0, 130.0]],
}


@pytest.mark.parametrize("through", [False, True])
@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_a_brush_touches_what_lies_within_its_radius_of_the_path(path, through):
    """Random Gaussians around the camera too, some in two thick layers; against a loop over each of them."""
    rng = seeded(3)
    means = torch.cat([4 * torch.rand(400, 3, generator=rng) - 2, _sheet(-0.4), _sheet(0.5)])
    means[:50, 1] -= 3  # behind the camera
    camera, sigma = _camera(), 0.03
    covariances = sigma**2 * torch.eye(3).expand(len(means), 3, 3)
    picture = render_torch(means, covariances, torch.full((len(means),), 0.9), torch.zeros_like(means), camera)
    found = touched(seen(means, covariances, camera, picture, 0.01), torch.tensor(path), 9.5, through).tolist()
    drawn = torch.where(picture.alpha < SOLID, math.inf, picture.depth / picture.alpha)[..., 0].tolist()
    expected = []
    for k, ((x, y), depth) in enumerate(zip(*(part.tolist() for part in project(means, camera)), strict=True)):
        if not (depth >= camera.near and 0 <= x < camera.width and 0 <= y < camera.height):
            continue
        across = math.sqrt(2) * sigma * float(camera.intrinsics[0, 0]) / depth  # of a ball, in both directions
        reach = REACH * sigma + _slope(drawn, int(y), int(x)) * (1 + REACH * across) + 0.01
        if (through or depth <= drawn[int(y)][int(x)] + reach) and _distance(x, y, path) <= 9.5:
            expected.append(k)
    assert found == expected
    assert bool(expected) == (path != PATHS["beside the picture"])
    assert through or not any(k >= 400 + 24**2 for k in found)  # nothing of the sheet behind


def test_a_brush_does_not_reach_through_the_object():
    """Of a sphere the half towards the camera, and all of it if wanted."""
    turn = math.pi * (3 - math.sqrt(5)) * torch.arange(4000)
    z = torch.linspace(-1, 1, 4000)
    around = (1 - z**2).sqrt()
    sphere = 0.8 * torch.stack([around * turn.cos(), around * turn.sin(), z], -1)
    view = _view(sphere, camera=_camera(240, 180))
    everything = torch.tensor([[120.0, 90.0]])
    front = touched(view, everything, 300.0)
    assert sphere[front, 1].max() < 0.05
    assert len(front) > 0.9 * (sphere[:, 1] < -0.8 * 0.8 / 3).sum()  # up to the horizon that the camera sees
    assert touched(view, everything, 300.0, through=True).tolist() == list(range(4000))


def test_a_surface_is_all_in_front_seen_at_a_slant():
    view = _view(_sheet(0.0, 40), camera=_camera(eye=(2.7, -1.2, 0.0)))
    assert view.inside.all()
    assert view.front.all()


def test_what_shines_through_hides_nothing():
    both = torch.cat([_sheet(-0.4), _sheet(0.5)])
    assert not _view(both).front[24**2 :].any()
    assert _view(both, opacity=0.1).front[24**2 :].all()


def test_a_slack_adds_layers_just_behind():
    both = torch.cat([_sheet(0.0), _sheet(0.15)])
    assert not _view(both).front[24**2 :].any()
    assert _view(both, slack=0.2).front[24**2 :].all()


def test_a_flat_gaussian_has_its_extent_along_the_line_of_sight():
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    picture = RenderOutput(torch.zeros(9, 9, 3), torch.ones(9, 9, 1), torch.full((9, 9, 1), 3.0))
    for depth, front in ((0.01, [True, False]), (0.3, [True, True])):
        covariances = torch.diag(torch.tensor([0.3, depth, 0.3]) ** 2).expand(2, 3, 3)
        assert seen(means, covariances, _camera(9, 9), picture).front.tolist() == front
