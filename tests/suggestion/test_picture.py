import json

import numpy as np
import pytest
import torch
import yaml
from shared import beyond, peak, seeded, up_to
from small_scenes import guess, plain_cloud, started, together

from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.geometry.regions import Box, Cylinder, Everything, HalfSpace, Not, Union
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.mpm.pins import Impulse, PinnedRegion
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera
from gaussian_swaying.rendering.tints import HELD
from gaussian_swaying.rendering.torch_renderer import render_torch
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Roles, Simulation, classify
from gaussian_swaying.suggestion.kinds import KINDS
from gaussian_swaying.suggestion.picture import (
    PUSHED,
    RADIUS,
    REGION,
    View,
    _whole,
    mean_flow,
    orbit_frame,
    preview_picture,
    roles_tinted,
    whole_box,
)
from gaussian_swaying.suggestion.suggestion import region_dict
from gaussian_swaying.wind.field import FlowKey, WindField

POLE = up_to(x=0.11)


def column(count=3000, side=0.3, height=2.0):
    points = torch.rand(count, 3, generator=seeded(0))
    return (points - torch.tensor([0.5, 0.5, 0.0])) * torch.tensor([side, side, height])


# ---- the whole object


def test_whole_object_has_what_does_not_move_and_no_floor_nor_specks():
    body = column()
    floor = column(4000, 6.0, 0.001) - torch.tensor([0.0, 0.0, 0.02])
    points = torch.cat([body, floor, torch.tensor([[0.8, 0.8, 0.3]]).repeat(5, 1)])
    high, opacity = points[:, 2].numpy(), np.full(len(points), 0.9)
    own = np.arange(len(points)) < 3000
    outside = ~own & (np.arange(len(points)) < 7000)

    def box(above):
        means = points.double().numpy()
        return whole_box(Gaussians(means, means, means, opacity, opacity, means), own & (high > above), outside, 0.06)

    low, top = box(1.2)
    assert low == pytest.approx([-0.15, -0.15, 0.4], abs=0.01)  # a longest side of 0.8 m below what moves
    assert top == pytest.approx([0.15, 0.15, 2.0], abs=0.01)
    assert box(0.8)[0][2] == pytest.approx(0.0, abs=0.01)
    opacity[own & (high < 0.8)] = 0.01  # haze is no object
    assert box(0.8)[0][2] == pytest.approx(0.8, abs=0.01)


def test_camera_of_the_starter_shows_all_of_it(tmp_path):
    cloud = plain_cloud(column())
    for region, below in ((None, 0.0), (([-1.0, -1.0, 1.1], [1.0, 1.0, 3.0]), 0.2)):
        found = guess(cloud, up="+z", region=region)
        assert found.whole[0][2] == pytest.approx(below, abs=0.05)
        simulation = started(found, cloud, tmp_path)
        camera = simulation.painter.camera_at(0)
        pixel, depth = project(cloud.means[cloud.means[:, 2] >= below], camera)
        assert depth.min() > 0
        edge = torch.tensor([camera.width, camera.height]) - pixel
        assert torch.minimum(pixel, edge).min() > 0.05 * camera.height  # room to sway
        assert float(pixel[:, 1].amax() - pixel[:, 1].amin()) > 0.5 * camera.height  # and yet large
        low, _ = _whole(simulation, classify(simulation))  # as a preview of this configuration has it
        assert low == pytest.approx(found.whole[0], abs=0.05)


def test_orbit_is_left_alone_where_all_of_it_moves():
    box = ([0.0, 0.0, 0.0], [1.0, 1.0, 2.0])
    assert orbit_frame(box, box) == ([0, 0, 0], RADIUS)
    offset, radius = orbit_frame(([0.0, 0.0, -2.0], [1.0, 1.0, 2.0]), box)
    assert offset == [0, 0, -0.5]
    assert radius == pytest.approx(2 * RADIUS)


def test_floor_is_not_framed(make_simulation):
    flag, side = FlagScene(spacing=0.1).generate(), torch.arange(-3, 3.01, 0.1)
    floor = torch.cartesian_prod(side, side, torch.tensor([-0.1]))
    cloud = together(flag, plain_cloud(floor, torch.tensor([0.08, 0.08, 0.001]).log()))
    simulation = make_simulation(cloud=cloud, scene={"region": beyond(z=0.0)})
    low, high = _whole(simulation, classify(simulation))
    assert low == pytest.approx(flag.means.amin(0).tolist(), abs=1e-5)
    assert high == pytest.approx(flag.means.amax(0).tolist(), abs=1e-5)


# ---- the picture


def test_tints_leave_three_tenths_of_the_colour_and_what_is_still_is_pale_and_grey():
    moving, pushed, pinned = (torch.tensor(row) for row in ([1, 1, 1, 1, 0], [0, 1, 0, 1, 0], [0, 0, 1, 1, 0]))
    none = torch.zeros(5, dtype=torch.bool)
    roles = Roles(simulated=moving.bool(), carried=none, pinned=pinned.bool(), pushed=pushed.bool(), names=[])
    push, pin = torch.tensor(PUSHED) / 255, torch.tensor(HELD) / 255
    for value in (0.0, 1.0):
        own = torch.full((3,), value)
        expected = [own, 0.3 * own + 0.7 * push, 0.3 * own + 0.7 * pin, 0.09 * own + 0.21 * push + 0.7 * pin]
        pale = torch.full((3,), 0.5 + 0.4 * value)
        torch.testing.assert_close(roles_tinted(own.expand(5, 3), roles), torch.stack([*expected, pale]))


def test_lines_are_where_the_renderer_draws():
    camera = look_at_camera((0.3, -3.0, 0.5), (0, 0, 0), (0, 0, 1), 40.0, 64, 48)
    point = torch.tensor([[0.31, 0.2, -0.17]])
    image = render_torch(point, 1e-6 * torch.eye(3)[None], torch.ones(1), torch.ones(1, 3), camera)
    row, line = divmod(int(image.alpha[..., 0].argmax()), 64)
    pixel, depth = project(point, camera)
    assert peak(pixel[0] - torch.tensor([line + 0.5, row + 0.5])) <= 0.5 + 1e-6
    assert float(depth) == pytest.approx(float(image.depth.max() / image.alpha.max()), rel=1e-5)
    view = View(torch.ones(1, 3), (point, 1e-6 * torch.eye(3)[None], torch.ones(1)), camera)
    view.box(np.array([-0.5, -9.0, -0.4]), np.array([0.5, 0.0, 0.4]), REGION)
    drawn = np.asarray(view.picture) == REGION
    x, y = project(torch.tensor([[0.0, 0.0, 0.4]]), camera)[0][0].round().int().tolist()
    assert drawn[y - 1 : y + 2, x].any()  # the middle of the upper edge behind
    assert not drawn[:, :3].any()


def test_parts_are_those_of_the_run(make_simulation):
    boundaries = [PinnedRegion(POLE), Impulse(beyond(x=0.8), [0, 0, 1]),
                  Wall(HalfSpace([0, 0, -9], [0, 0, 1]))]  # fmt: skip
    cloud = FlagScene(spacing=0.1).generate()
    cloud.opacities[-8:] = -6.0  # the last column is faint
    simulation = make_simulation(cloud=cloud, pinned=False, boundaries=boundaries, scene={"region": Not(
        beyond(z=0.6))})  # fmt: skip
    roles, (x, _, z) = classify(simulation), cloud.means.unbind(-1)
    assert torch.equal(roles.simulated, (z < 0.6) & (x < 1.1))
    assert torch.equal(roles.carried, (z < 0.6) & (x > 1.1))
    assert torch.equal(roles.pinned, (x < 0.11) & (z < 0.6))
    assert torch.equal(roles.pushed, (x > 0.8) & (x < 1.1) & (z < 0.6))
    assert roles.names == ["PinnedRegion: 6 particles", "Impulse: 18 particles", "Wall"]


def test_flow_is_the_strongest_of_a_schedule(make_simulation):
    wind = WindField(schedule=[FlowKey(0.0, [0, 0, 0]), FlowKey(1.0, [0, 5, 0]), FlowKey(2.0, [1, 0, 0])])
    assert mean_flow(make_simulation(wind=wind)).tolist() == [0, 5, 0]
    assert mean_flow(make_simulation(wind=WindField([1.0, 2.0, 3.0]))).tolist() == [1, 2, 3]


def test_picture_shows_pinned_and_static_gaussians(make_simulation):
    cloud = FlagScene(spacing=0.1, pattern="white").generate()
    camera = LookAtCamera([0.6, -2.5, 0.4], [0.6, 0.0, 0.4])
    picture = preview_picture(make_simulation(cloud=cloud, camera=camera), height=120)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (240, 3)
    assert picture.shape[0] > 120
    view = picture[:120, :120].astype(int)

    def red(view):
        return (view[..., 0] > view[..., 1] + 60) & (view[..., 1] < 140)

    white = (view.min(-1) > 200) & (view.max(-1) < 240)  # of the flag, not of the background
    assert red(view).sum() > 50
    assert np.nonzero(red(view).any(0))[0].max() < np.nonzero(white.any(0))[0].max()  # the pole is on the left
    assert list(picture[-1, -1]) == [255, 255, 255]
    free = preview_picture(make_simulation(cloud=cloud, pinned=False, camera=camera), height=120)
    assert red(free[:120, :120].astype(int)).sum() < red(view).sum() / 4


# ---- the configuration


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
    assert region.contains(points).any()
    with pytest.raises(TypeError, match="but got Everything"):
        region_dict(Everything())


def test_configuration_has_the_numbers_of_the_suggestion(tmp_path):
    folder = tmp_path / "a splat #1 'é'"
    folder.mkdir()
    cloud = FlagScene(spacing=0.05).generate()
    found = guess(cloud)
    simulation = started(found, cloud, folder, frames=3)
    text = (folder / "starter.yaml").read_text()
    assert simulation.frames_wanted == 3
    assert simulation.solver.dx == found.dx
    assert len(simulation.scene.simulated) == found.moving.simulated.sum()
    assert simulation.scene.frame.metres_per_unit == pytest.approx(found.metres_per_unit)
    assert torch.equal(classify(simulation).pinned, found.pin.contains(cloud.means))
    assert mean_flow(simulation).tolist() == list(found.flow)
    assert max(map(len, text.splitlines())) <= 170, "a line of the file is too long to read"
    settings = yaml.safe_load(text)
    assert settings["scene"]["ply"] == str(folder / "it.ply")
    assert settings["material"]["damping_ratio"] == KINDS["flag"].damping_ratio
    assert settings["material"]["density"] * settings["material"]["thickness"] == pytest.approx(KINDS["flag"].mass)
    free = yaml.safe_load(guess(cloud, hold="none").to_yaml(folder / "free.yaml"))  # and its Gaussians
    assert (free["solver"]["boundaries"], free["solver"]["gravity"]) == ([], [0, 0, -9.8])
    assert (folder / "splat.ply").exists()


def test_a_given_material_has_its_own_numbers(tmp_path):
    """The configuration says no more than its name."""
    silk = MATERIALS["silk"]
    found = guess(FlagScene(spacing=0.05).generate(), material="silk")
    text = found.to_yaml(tmp_path / "silk.yaml")
    assert yaml.safe_load(text)["material"] == "silk"
    assert "in still air" not in text
    settings = parse_text(Simulation.parser(), text)
    assert {name: settings.material[name] for name in silk.numbers} == silk.numbers
    assert (settings.solver.formulation, settings.solver.damping) == ("total", silk.damping)
