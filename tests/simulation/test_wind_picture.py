from dataclasses import replace

import imageio.v3 as iio
import pytest
import torch
from shared import near, peak, value_error

from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.rendering.passes import mean_depth
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.draw import STEPS, View, streaks
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.effects import Obstacle
from gaussian_swaying.wind.field import WindField


def test_streaks_follow_the_wind(make_simulation):
    simulation = make_simulation()
    simulation.wind = WindField([3.0, 0.0, 4.0])
    state = simulation.start()
    camera = simulation.painter.camera_at(0)
    places, speeds = streaks(simulation.stepper, state, camera)
    assert places.shape[1:] == (STEPS + 1, 3)
    torch.testing.assert_close(speeds, torch.full_like(speeds, 5.0))
    way = places[:, -1] - places[:, 0]
    torch.testing.assert_close(
        way / way.norm(dim=-1, keepdim=True), torch.tensor([0.6, 0.0, 0.8]).double().expand_as(way)
    )
    torch.testing.assert_close(way.norm(dim=-1), way.norm(dim=-1)[:1].expand(len(way)))
    short = 0.02 * float(way[0].norm()) / 5.0
    moved, _ = streaks(simulation.stepper, state.replace(time=state.time + short), camera)
    drift = moved[:, 0] - places[:, 0]
    kept = drift.norm(dim=-1) < 10 * short * 5.0  # the others came in again at the other side
    assert kept.float().mean() > 0.9
    torch.testing.assert_close(drift[kept], (short * torch.tensor([3.0, 0.0, 4.0])).double().expand_as(drift[kept]))


def test_streaks_of_air_that_turns_are_circles(make_simulation, monkeypatch):
    """Steps of the second order, of at most 0.1 rad: the radius grows by 0.1^4 / 8 in each."""
    simulation = make_simulation()
    simulation.wind = WindField([3.0, 0.0, 0.0])
    state, camera = simulation.start(), simulation.painter.camera_at(0)
    seconds = float((streaks(simulation.stepper, state, camera)[0].diff(dim=1).norm(dim=-1).sum(1) / 3.0)[0])
    rate = 0.1 * STEPS / seconds
    monkeypatch.setattr(
        simulation.stepper, "air_at", lambda _, x: rate * torch.stack([-x[:, 2], 0 * x[:, 1], x[:, 0]], 1)
    )
    places = simulation.scene.frame.point_to_sim(streaks(simulation.stepper, state, camera)[0].reshape(-1, 3))
    radius = places[:, [0, 2]].norm(dim=-1).view(-1, STEPS + 1)
    torch.testing.assert_close(radius[:, -1], radius[:, 0], rtol=2 * STEPS * 0.1**4 / 8, atol=1e-6)


@pytest.mark.parametrize(("distance", "angle", "height"), [(3.0, 40.0, 90), (7.0, 25.0, 300)])
def test_streaks_fill_the_picture_and_are_an_eighth_of_it_long(make_simulation, distance, angle, height):
    """Seen from the side, in a plane through the middle: an eighth of 1.15 widths, which leave no edge without air."""
    simulation = make_simulation()
    simulation.wind = WindField([5.0, 0.0, 0.0])
    state, centre = simulation.start(), simulation.scene.center.double()
    eye = centre - distance * torch.tensor([0.0, 1.0, 0.0])
    camera = look_at_camera(eye.tolist(), centre.tolist(), (0.0, 0.0, 1.0), angle, 160, height, dtype=torch.float64)
    places, _ = streaks(simulation.stepper, state, camera)
    pixel, depth = project(places.reshape(-1, 3), camera)
    torch.testing.assert_close(depth, torch.full_like(depth, distance), rtol=1e-5, atol=0)  # air in float32
    pixel = pixel.view(len(places), -1, 2)
    long = (pixel[:, -1] - pixel[:, 0]).norm(dim=-1)
    torch.testing.assert_close(long, torch.full_like(long, 1.15 * 160 / 8), rtol=1e-5, atol=0)
    assert (pixel[:, 0].amin(0) < 0).all()
    assert (pixel[:, 0].amax(0) > torch.tensor([160, height])).all()


def test_the_object_hides_what_is_behind_it(make_simulation):
    """Air is drawn over the background, and the picture without air is the pale one of the object."""
    simulation = make_simulation()
    state = simulation.start()
    painter = simulation.painter
    view = View(painter, state, painter.deformed(state), painter.camera_at(0))
    found = view.wind()
    pale = 0.75 * view.picture.color.clamp(0, 1) + 0.25
    assert found.shape == pale.shape
    assert (found - pale).abs().amax(-1).gt(0.05).float().mean() > 0.02
    simulation.wind = WindField([0.0, 0.0, 0.0])
    assert torch.isfinite(view.wind()).all()


@pytest.mark.parametrize("flow", [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
def test_a_run_draws_the_wind(make_simulation, tmp_path, flow):
    simulation = make_simulation()
    simulation.wind = WindField(flow, effects=[Obstacle([-1.0, 0.0, 0.4], [0.3] * 3)])
    simulation.run(tmp_path / "run", 1, progress=False, recorder=Recorder(renders=["wind"]))
    picture = iio.imread(tmp_path / "run" / "wind" / "00000.png")
    assert picture.shape == (18, 32, 3)
    assert (tmp_path / "run" / "wind.mp4").exists()
    assert not (tmp_path / "run" / "frames").exists()


def _in_air():
    box = ComputedAir([-1.2, -0.9, -0.9], [1.5, 0.9, 0.9], 27, speed=6.0)
    return Simulation(FlagScene(spacing=0.05), wind=[3.0, 0.0, 0.0], air=box)


@pytest.mark.parametrize("spin", [20.0, -20.0])
def test_vorticity_is_red_where_air_turns_against_the_clock(spin):
    simulation = _in_air()
    stepper, state = simulation.stepper, simulation.start()
    centre = simulation.scene.center.double()
    eye = centre + 4.0 * torch.tensor([0.0, -1.0, 0.0])
    camera = look_at_camera(eye.tolist(), centre.tolist(), (0.0, 0.0, 1.0), 60.0, 96, 64)
    x, _, z = stepper.air._centres(stepper.air.flow.cells).permute(3, 0, 1, 2).float()
    state.air[1:4] = torch.stack([-spin / 2 * z, 0 * x, spin / 2 * x]) / stepper.air.flow.units.speed
    inside = stepper.air.vorticity_at(state.air, torch.tensor([[0.1, 0.2, 0.3], [0.1, 0.2, 3.0]]))
    torch.testing.assert_close(inside, torch.tensor([[0.0, -spin, 0.0], [0.0, 0.0, 0.0]]), rtol=1e-4, atol=1e-3)
    view = View(simulation.painter, state, simulation.painter.deformed(state), camera)
    seen, found = view.picture, view.vorticity()
    change = found - (0.5 * seen.color.clamp(0, 1) + 0.5)
    size = float((state.position.amax(0) - state.position.amin(0)).amax())
    colour = torch.tensor([0.70, 0.09, 0.17] if spin > 0 else [0.13, 0.40, 0.67])
    under = 0.5 * seen.color[32, 62] + 0.5
    near(found[32, 62], torch.lerp(under, colour, 20.0 * size / (8 * 3.0)), 2e-3)
    red_less_blue = change[..., 0] - change[..., 2]
    assert float(red_less_blue[32, 62]) * spin > 1.0  # behind the flag
    assert float(peak(change[2, 2])) == 0
    bare = replace(view, state=state.replace(air=torch.zeros_like(state.air))).vorticity()
    assert float(peak(bare - (0.5 * seen.color.clamp(0, 1) + 0.5))) == 0
    covered = mean_depth(seen) > 0
    assert covered[32, 48]
    for nearer, hides in ((0.9, True), (1.1, False)):  # the flag in front of the plane, and behind it
        vars(view)["picture"] = replace(seen, depth=nearer * seen.depth)
        change = view.vorticity() - (0.5 * seen.color.clamp(0, 1) + 0.5)
        assert bool((change[covered] == 0).all()) == hides


def test_a_run_draws_vorticity_in_computed_air_alone(make_simulation, tmp_path):
    simulation = _in_air()
    simulation.run(tmp_path / "run", 1, progress=False, recorder=Recorder(renders=["vorticity"]))
    assert iio.imread(tmp_path / "run" / "vorticity" / "00000.png").ndim == 3
    with value_error("which only computed air has: add `air`"):
        make_simulation().run(tmp_path / "other", 1, progress=False, recorder=Recorder(renders=["vorticity"]))
    assert not (tmp_path / "other").exists()
