"""What a preview draws, writes as a configuration, and expects of the cost."""

import json

import numpy as np
import pytest
import torch
import yaml

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.regions import Box, Cylinder, Everything, Not, Sphere, Union
from gaussian_swaying.mpm.colliders import Plane
from gaussian_swaying.mpm.pins import Impulse, PinnedRegion
from gaussian_swaying.preview.picture import (
    PINNED,
    PUSHED,
    _tinted,
    box_edges,
    mean_flow,
    preview_picture,
    project,
    region_box,
)
from gaussian_swaying.preview.starter import region_dict, starter_yaml
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.torch_renderer import render_torch
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Roles, Simulation, classify
from gaussian_swaying.wind.field import FlowKey, WindField

POLE = Box([None, None, None], [0.11, None, None])


# ---- picture


def test_tints_leave_three_tenths_of_the_colour_and_what_is_still_is_pale_and_grey():
    """Black and white Gaussians: moving, pushed, pinned, both, and not simulated."""
    moving, pushed, pinned = (torch.tensor(row) for row in ([1, 1, 1, 1, 0], [0, 1, 0, 1, 0], [0, 0, 1, 1, 0]))
    none = torch.zeros(5, dtype=torch.bool)
    parts = Roles(simulated=moving.bool(), carried=none, pinned=pinned.bool(), pushed=pushed.bool(), names=[])
    push, pin = torch.tensor(PUSHED) / 255, torch.tensor(PINNED) / 255
    for value in (0.0, 1.0):
        own = torch.full((3,), value)
        expected = [own, 0.3 * own + 0.7 * push, 0.3 * own + 0.7 * pin, 0.09 * own + 0.21 * push + 0.7 * pin]
        pale = torch.full((3,), 0.5 + 0.4 * value)
        torch.testing.assert_close(_tinted(own.expand(5, 3), parts), torch.stack([*expected, pale]))


def test_projection_is_that_of_the_renderer():
    camera = look_at_camera((0.3, -3.0, 0.5), (0, 0, 0), (0, 0, 1), 40.0, 64, 48)
    point = torch.tensor([[0.31, 0.2, -0.17]])
    image = render_torch(point, 1e-6 * torch.eye(3)[None], torch.ones(1), torch.ones(1, 3), camera)
    row, column = divmod(int(image.alpha[..., 0].argmax()), 64)
    pixel, depth = project(point, camera)
    assert float((pixel[0] - torch.tensor([column + 0.5, row + 0.5])).abs().max()) <= 0.5 + 1e-6
    assert float(depth) == pytest.approx(float(image.depth.max() / image.alpha.max()), rel=1e-5)
    assert float(project(torch.tensor([[0.3, -6.0, 0.5]]), camera)[1]) < 0


def test_edges_and_box_of_a_region():
    edges = box_edges([0, 0, 0], [1, 2, 3])
    assert sorted((edges[:, 0] - edges[:, 1]).norm(dim=-1).tolist()) == [1] * 4 + [2] * 4 + [3] * 4
    low, high = torch.zeros(3), torch.ones(3)
    assert region_box(POLE, low, high) == ([0, 0, 0], [0.11, 1, 1])
    assert region_box(Box([2, None, None], [None, None, None]), low, high) is None
    assert region_box(Sphere([0, 0, 0], 1), low, high) is None


def test_parts_are_those_of_the_run(make_simulation):
    boundaries = [PinnedRegion(POLE), Impulse(Box([0.8, None, None], [None, None, None]), [0, 0, 1]),
                  Plane([0, 0, -9], [0, 0, 1])]  # fmt: skip
    cloud = FlagScene(spacing=0.1).generate()
    cloud.opacities[-8:] = -6.0  # the last column is faint
    simulation = make_simulation(cloud=cloud, pinned=False, boundaries=boundaries, scene={"region": Not(
        Box([None, None, 0.6], [None, None, None]))})  # fmt: skip
    parts = classify(simulation)
    x, z = cloud.means[:, 0], cloud.means[:, 2]
    assert torch.equal(parts.simulated, (z < 0.6) & (x < 1.1))
    assert torch.equal(parts.carried, (z < 0.6) & (x > 1.1))
    assert torch.equal(parts.pinned, (x < 0.11) & (z < 0.6))
    assert torch.equal(parts.pushed, (x > 0.8) & (x < 1.1) & (z < 0.6))
    assert parts.names == ["PinnedRegion: 6 particles", "Impulse: 18 particles", "Plane"]


def test_flow_is_the_strongest_of_a_schedule(make_simulation):
    wind = WindField(schedule=[FlowKey(0.0, [0, 0, 0]), FlowKey(1.0, [0, 5, 0]), FlowKey(2.0, [1, 0, 0])])
    assert mean_flow(make_simulation(wind=wind)).tolist() == [0, 5, 0]
    assert mean_flow(make_simulation(wind=WindField([1.0, 2.0, 3.0]))).tolist() == [1, 2, 3]


def test_picture_shows_pinned_and_static_gaussians(make_simulation):
    """The flag is white: red where it is held, grey-blue lines apart nothing else."""
    from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera

    cloud = FlagScene(spacing=0.1, pattern="white").generate()
    simulation = make_simulation(cloud=cloud, camera=LookAtCamera([0.6, -2.5, 0.4], [0.6, 0.0, 0.4]))
    picture = preview_picture(simulation, height=120)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (240, 3)
    assert picture.shape[0] > 120
    view = picture[:120, :120].astype(int)
    reddish = (view[..., 0] > view[..., 1] + 60) & (view[..., 1] < 140)
    columns = np.nonzero(reddish.any(0))[0]
    whiteish = (view.min(-1) > 200) & (view.max(-1) < 240)  # of the flag, not of the background
    assert reddish.sum() > 50
    assert columns.max() < np.nonzero(whiteish.any(0))[0].max()  # the pole is on the left
    assert list(picture[-1, -1]) == [255, 255, 255]
    unpinned = preview_picture(make_simulation(cloud=cloud, pinned=False, camera=simulation.painter.camera), height=120)
    bare = unpinned[:120, :120].astype(int)
    assert ((bare[..., 0] > bare[..., 1] + 60) & (bare[..., 1] < 140)).sum() < reddish.sum() / 4
    assert PINNED[0] > PINNED[1] + 60


# ---- cost


# ---- starter


@pytest.mark.parametrize(
    "region",
    [
        POLE,
        Cylinder([0, 1, 2], [0, 0, 2], 0.5, 3.0),
        Not(Union([Not(Box([0, 0, 0], [1, 1, 1])), Box([0.2, 0.2, 0.2], [0.3, 0.4, 0.5])])),
    ],
)
def test_region_survives_the_yaml(region):
    from jsonargparse import ArgumentParser

    from gaussian_swaying.geometry.regions import Region

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--region", type=Region)
    text = yaml.safe_dump({"region": json.loads(json.dumps(region_dict(region)))})
    back = parser.instantiate(parser.parse_string(text)).region
    points = 3 * torch.rand(500, 3) - 0.5
    assert torch.equal(back.contains(points), region.contains(points))
    assert bool(region.contains(points).any())
    with pytest.raises(TypeError, match="but got Everything"):
        region_dict(Everything())


def test_starter_has_the_numbers_of_the_suggestion(tmp_path):
    path = tmp_path / "a splat #1 'é'.ply"
    cloud = FlagScene(spacing=0.05).generate()
    write_ply(path, cloud)
    found = suggest(cloud)
    config = tmp_path / "starter.yaml"
    config.write_text(starter_yaml(found, path, frames=3), encoding="utf-8")
    parser = Simulation.parser()
    settings = parser.parse_args(["--config", str(config), "--device", "cpu"])
    assert settings.frames == 3
    assert settings.scene.ply == str(path)
    simulation = Simulation.from_settings(parser, settings)
    assert simulation.solver.dx == found.dx
    assert len(simulation.scene.simulated) == int(found.region.simulated.sum())
    assert simulation.scene.frame.metres_per_unit == pytest.approx(found.metres_per_unit)
    assert torch.equal(classify(simulation).pinned, found.pin.contains(cloud.means))
    assert mean_flow(simulation).tolist() == list(found.flow)
    longest = max(len(line) for line in starter_yaml(found, "x.ply").splitlines())
    assert longest <= 160, "a line of the file is too long to read"
    free = yaml.safe_load(starter_yaml(suggest(cloud, hold="none"), path))
    assert free["solver"]["boundaries"] == []
