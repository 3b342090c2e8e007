import imageio.v3 as iio
import numpy as np
import pytest
import torch
from shared import near, peak, up_to, value_error

from gaussian_swaying._fixed import changed
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.recording.layout import video_file
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.rendering.cameras.keyframes import CameraKey
from gaussian_swaying.rendering.passes import colormap, mean_depth
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.simulation.draw import View
from gaussian_swaying.simulation.model import Edit
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce

SIDE = OrbitCamera(width=24, height=20, azimuth=-90.0, elevation=0.1, radius=1.5)
ALL = ["color", "depth", "normal", "force", "wind"]


def _cameras(simulation, **cameras):
    simulation.painter.cameras = cameras
    return simulation


def test_files_of_a_run_with_two_cameras_and_all_renders(make_simulation, tmp_path):
    simulation = _cameras(make_simulation(), side=SIDE)
    summary = simulation.run(tmp_path / "run", 2, progress=False, recorder=Recorder(renders=ALL))
    for prefix, size in (("", (18, 32)), ("cameras/side/", (20, 24))):
        for folder in ("frames", "depth", "normal", "force", "wind"):
            for frame in range(2):
                picture = iio.imread(tmp_path / "run" / prefix / folder / f"{frame:05d}.png")
                assert picture.shape == (*size, 3)
                assert picture.any()
            video = "video" if folder == "frames" else folder
            assert iio.imread(tmp_path / "run" / prefix / f"{video}.mp4").shape == (2, *size, 3)
        raw = iio.imread(tmp_path / "run" / prefix / "depth_raw" / "00001.png")
        assert raw.shape == size
        assert raw.dtype == np.uint16
    assert summary["force_scale_Pa"] == pytest.approx(0.5 * 1.225 * (6.0**2 + 1.5**2) * 0.91)
    told = {path.name for path in simulation.files}
    assert told >= {"video.mp4", "depth.mp4", "normal.mp4", "force.mp4", "depth_raw"}


def test_a_resumed_run_has_all_pictures(make_simulation, tmp_path):
    folder, recorder = tmp_path / "run", {"renders": ["color", "normal"]}
    _cameras(make_simulation(), side=SIDE).run(folder, 1, progress=False, recorder=Recorder(**recorder))
    _cameras(make_simulation(), side=SIDE).run(folder, 3, resume=True, progress=False, recorder=Recorder(**recorder))
    for place in ("frames", "normal", "cameras/side/frames", "cameras/side/normal"):
        assert len(list((folder / place).glob("[0-9]*.png"))) == 3
        assert len(iio.imread(folder / video_file(place))) == 3


def test_the_depth_on_disk_is_in_metres(make_simulation, tmp_path):
    simulation = make_simulation(scene={"metres_per_unit": 2.0})
    simulation.run(tmp_path / "run", 1, progress=False, recorder=Recorder(renders=["depth"]))
    state = simulation.start()
    depth = 2.0 * mean_depth(simulation.painter.render(state, 0)).numpy()
    raw = iio.imread(tmp_path / "run" / "depth_raw" / "00000.png")
    assert (raw > 0).any()
    assert np.abs(0.001 * raw - depth).max() <= 0.0005 + 1e-5
    assert not (tmp_path / "run" / "frames").exists()
    assert not (tmp_path / "run" / "video.mp4").exists()


def _at_rest(simulation, camera="", **more):
    painter = simulation.painter
    return View(painter, simulation.start(), painter.scene.rest(), painter.camera_at(0, camera), **more)


def test_normals_of_a_flat_flag(make_simulation):
    """Seen along its normal -y: towards the camera in its axes, -y in the world's, whatever the scene's up."""
    simulation = _cameras(make_simulation(), side=SIDE)
    for world, normal in ((False, [0.0, 0.0, 1.0]), (True, [0.0, -1.0, 0.0])):
        found = 2 * _at_rest(simulation, "side", live=world).normals()[10, 12] - 1
        # the flag ripples: its slope is up to 2 pi 1.5 ripple / width = 0.24
        assert float(found @ torch.tensor(normal)) > 0.95
        assert float(found.norm()) == pytest.approx(1.0, abs=1e-5)


def test_normals_in_world_axes_are_those_of_the_z_up_frame(flag_ply, make_simulation):
    simulation = _cameras(make_simulation(read_ply(flag_ply), pinned=False, scene={"up": [0.0, 1.0, 0.0]}), side=SIDE)
    normals = simulation.scene.patches.normal
    found = 2 * _at_rest(simulation, "side", live=True).normals()[10, 12] - 1
    expected = normals[len(normals) // 2]
    assert abs(float(found @ expected)) > 0.95
    assert abs(float(found[2])) < 0.1  # the flag hangs, so no normal points up


def test_the_force_is_that_of_the_wind(make_simulation):
    aero = AeroForce(C_D=0.5, C_F=0.0, C_L=0.0)
    simulation = make_simulation(wind=WindField([0.0, 4.0, 0.0]), aero=aero)
    state = simulation.start()
    pressure = simulation.stepper.wind_pressure(state)
    torch.testing.assert_close(pressure, torch.full_like(pressure, 0.5 * 1.225 * 16 * 0.5))
    assert simulation.stepper.force_scale() == pytest.approx(float(pressure[0]))
    picture = _at_rest(simulation, force_end=2 * float(pressure[0])).pressure()
    covered = picture.any(-1)
    assert covered.any()
    expected = colormap(torch.tensor(0.5)).expand_as(picture[covered])
    near(picture[covered], expected, 1e-5)
    moving = state.replace(velocity=torch.tensor([0.0, 4.0, 0.0]).expand_as(state.velocity))
    assert peak(simulation.stepper.wind_pressure(moving)) < 1e-6
    assert not make_simulation(aero=AeroForce(air_density=0.0)).stepper.wind_pressure(state).any()


def test_values_reach_every_gaussian_that_moves(make_cloud, make_scene):
    cloud = make_cloud()
    cloud.opacities[5] = -6.0
    scene = make_scene(cloud, region=up_to(x=0.5))
    values = torch.arange(1.0, 1 + len(scene.simulated))
    found = scene.on_gaussians(values[scene.owner])
    assert torch.equal(found[scene.simulated], values)
    assert torch.equal(found[scene.carried], values[scene.owner[len(scene.simulated) :]])
    static = torch.ones(len(cloud), dtype=torch.bool)
    static[scene.moving] = False
    assert static.any()
    assert not found[static].any()


def test_bad_names_and_renders(make_cloud, make_simulation):
    with value_error(r"names of `cameras` .* but got '\.\./up'"):
        make_simulation(parts={"cameras": {"../up": SIDE}})
    inside = _cameras(
        make_simulation(make_cloud(), pinned=False), near=OrbitCamera(width=8, height=8, radius=0.01, elevation=0.1)
    )
    with value_error(r"lies inside the object.*`cameras\.near\.init_args\.radius`"):
        inside.painter.check_camera(0)
    for renders, word in (
        (["colour"], "recorder.renders"),
        (["color"] * 2, "list of different ones"),
        ("color", "list of texts"),
    ):
        with pytest.raises((TypeError, ValueError), match=word):
            Recorder(renders=renders)


def test_a_camera_that_does_not_move_is_made_once(make_simulation):
    painter = make_simulation().painter
    painter.camera = OrbitCamera(width=8, height=8)
    first = painter.camera_at(0)
    assert painter.camera_at(3) is first
    painter.camera = changed(painter.camera, azimuth=10.0 + painter.camera.azimuth)
    assert not torch.equal(painter.camera_at(3).world_to_camera, first.world_to_camera)
    painter.camera = LookAtCamera(keys=[CameraKey(0.0, [0, -3, 0]), CameraKey(1.0, [1, -3, 0])], width=8, height=8)
    assert not torch.equal(painter.camera_at(4).position, painter.camera_at(3).position)
    painter.camera = LookAtCamera([0.0, -3.0, 0.0], [0.0, 0.0, 0.0], width=8, height=8)
    painter.cameras = {"top": OrbitCamera(elevation=80.0, width=8, height=8)}
    third, top = painter.camera_at(0), painter.camera_at(0, "top")
    assert (painter.camera_at(1), painter.camera_at(1, "top")) == (third, top)


def test_motion_and_colours_are_those_of_the_scene_in_every_frame(make_simulation, device):
    simulation = make_simulation(dx=0.2, scene={"points": "grid"}).to(device)
    painter, scene = simulation.painter, simulation.scene
    painter.shader = DiffuseShader([0.3, -0.6, 1.0]).to(device)
    with torch.inference_mode():
        state, kept = simulation.start(), []
        for k in range(8):
            if k == 3:
                painter.camera = OrbitCamera(azimuth=70.0, width=8, height=8)
            if k == 4:
                painter.shader = changed(painter.shader, ambient=0.5)
            if k == 6:
                state = simulation.edit(state, Edit(color=[1.0, 0.0, 0.0]))
            camera = painter.camera_at(k)
            found, expected = painter.deformed(state), scene.deformed(state)
            for name in ("means", "covariances", "normals"):
                torch.testing.assert_close(getattr(found, name), getattr(expected, name))
            if scene.model.view_dependent:
                torch.testing.assert_close(found.rotations, expected.rotations)
            colours = painter.colors(found, camera)
            turned = (expected.rotations,) if scene.model.view_dependent else ()
            torch.testing.assert_close(
                colours, painter._colors(camera.position, expected.means, expected.normals, *turned)
            )
            kept.append((colours, colours.clone(), found.means, found.means.clone()))
            state, _ = simulation.advance(state)
    for colours, copy, means, its_copy in kept:  # later frames leave them alone
        assert torch.equal(colours, copy)
        assert torch.equal(means, its_copy)
    assert not torch.equal(kept[0][2], kept[-1][2])
    assert not torch.equal(kept[3][0], kept[4][0])
    assert not torch.equal(kept[5][0], kept[6][0])
    if device.type == "cuda":
        assert any(painter._moved._repeater._graphs.values())
