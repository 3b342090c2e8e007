import copy
import dataclasses
import json
import math
from dataclasses import replace

import pytest
import torch
from shared import ZERO, advanced, double, in_both, longest, normalized, peak, seeded, up_to, value_error, without_waits

from gaussian_swaying.captures.capture_camera import CaptureCamera
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.rendering.cameras.camera import orbit_camera
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.rendering.gsplat_renderer import GsplatRenderer, make_renderer
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.rendering.torch_renderer import render_torch
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import Edit
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import GaussianGust, SineSway, WindField
from gaussian_swaying.wind.force import AeroForce

# ---- time


@in_both
def test_the_substep_does_not_depend_on_the_frame(formulation, make_simulation):
    """0.16 s in frames of 40, 80 or 160 ms with gusts that change every 40 ms: the same substeps, the same motion."""
    ends = []
    for frame_dt, frames in ((0.04, 4), (0.08, 2), (0.16, 1)):
        wind = WindField([6.0, 1.5, 0.0], modulations=[SineSway(period=0.3), GaussianGust(1.0)])
        settings = {"frame_dt": frame_dt, "formulation": formulation, "substep": 0.004, "dtype": torch.float64}
        state, log = advanced(make_simulation(wind=wind, **settings), frames)
        assert [health.substeps for health in log] == [round(frame_dt / 0.004)] * frames
        assert float(state.time) == pytest.approx(0.16)
        ends.append(state.position)
    moved = float(peak(ends[0] - make_simulation(dtype=torch.float64).start().position))
    assert moved > 0.05
    for end in ends[1:]:
        torch.testing.assert_close(end, ends[0], rtol=0, atol=1e-9)


def test_the_adaptive_substep_follows_the_courant_number(make_simulation):
    """c = sqrt((lambda + 2 mu) / rho) at rest: ceil(frame_dt c / (cfl dx)) substeps, whatever the frame."""
    speed = math.sqrt(3e3 * 0.7 / (1.3 * 0.4) / 30.0)
    for frame_dt in (0.04, 0.1):
        for cfl in (0.4, 0.1):
            simulation = make_simulation(wind=WindField(), frame_dt=frame_dt, cfl=cfl, gravity=ZERO)
            _, (health,) = advanced(simulation, 1)
            assert health.substeps == math.ceil(frame_dt * speed / (cfl * 0.2))
            assert health.cfl == pytest.approx(frame_dt / health.substeps * speed / 0.2, rel=1e-5)


def test_aerodynamics_are_asked_only_where_they_can_push(make_simulation, monkeypatch):
    calls = []
    on_patches = AeroForce.on_patches
    monkeypatch.setattr(AeroForce, "on_patches", lambda self, *a: calls.append(1) or on_patches(self, *a))
    for aero in (AeroForce(C_D=0.0, C_F=0.0, C_L=0.0), AeroForce(air_density=0.0)):
        assert aero.idle
        _, (health,) = advanced(make_simulation(aero=aero, transfer="torch"), 1)
        assert calls == []
        assert health.kinetic > 0
    _, (health,) = advanced(make_simulation(transfer="torch"), 1)
    assert len(calls) == health.substeps


def test_still_air_resists_a_fall(make_simulation):
    light = Material(E=1e3, density=10.0, thickness=1e-3)
    speed = []
    for air in (0.0, 1.225):
        aero = AeroForce(C_D=1.0, C_F=1.0, air_density=air)
        simulation = make_simulation(wind=WindField(), aero=aero, material=light, pinned=False)
        state, _ = advanced(simulation, 5)
        speed.append(-float(state.velocity[:, 2].mean()))
    assert speed[0] == pytest.approx(9.8 * 0.2, rel=1e-4)
    assert speed[1] < 0.9 * speed[0]


@pytest.mark.parametrize("name", ["C_D", "C_F", "C_L"])
def test_a_coefficient_that_became_nan_is_named(make_simulation, name):
    simulation = make_simulation()
    with torch.no_grad():
        getattr(simulation.aero, name).fill_(torch.nan)
    with pytest.raises(SimulationDiverged, match=rf"`aero\.{name}` is nan\. Remedy: set it to a finite number\.$"):
        advanced(simulation, 1)


def test_a_grid_that_was_outrun_is_enlarged(make_simulation):
    simulation = make_simulation(wind=WindField([0.0, 25.0, 0.0]), pinned=False, formulation="updated")
    state, _ = advanced(simulation, 3)
    assert not state.lost.any()
    assert longest(state.position - simulation.scene.points.position) > 0.1


def test_a_frame_whose_substep_was_too_long_is_done_again(make_simulation, monkeypatch):
    """The first try ends with a Courant number of 2, so more substeps are taken, from the same start."""
    simulation = make_simulation(wind=WindField())
    state = simulation.start()
    _, expected = advanced(make_simulation(wind=WindField()), 1)
    tries = []
    roll = simulation.stepper.roll

    def record(start, steps, margin):
        tries.append((start, steps))
        end, courant = roll(start, steps, margin)
        return end, torch.full_like(courant, 2.0) if len(tries) == 1 else courant

    monkeypatch.setattr(simulation.stepper, "roll", record)
    end, health = simulation.advance(state)
    steps = [n for _, n in tries]
    assert steps[0] < steps[1] <= 4 * steps[0] + 1
    assert len(tries) == 2
    assert health.substeps == steps[1] > expected[0].substeps
    assert torch.equal(tries[0][0].position, tries[1][0].position)
    assert float(end.time) == pytest.approx(0.04)


# ---- energy, tearing, light things


def test_semi_implicit_drag_needs_no_shorter_substep(make_simulation):
    """A storm on a sheet of 0.02 kg/m²: hundreds of substeps of explicit drag, or the elastic ones."""
    storm = WindField([0.0, 100.0, 0.0])
    light = Material(E=3e3, density=2.0)
    substeps = {}
    for step in ("explicit", "semi_implicit"):
        aero = AeroForce(C_D=1.2, C_F=0.0, C_L=0.0, law="projected", drag_step=step)
        simulation = make_simulation(wind=storm, aero=aero, material=light, pinned=False, gravity=ZERO)
        state, log = advanced(simulation, 2)
        substeps[step] = log[0].substeps
        assert float(state.velocity[:, 1].mean()) == pytest.approx(100.0, rel=0.05)
    assert substeps["explicit"] > 2 * substeps["semi_implicit"]


# ---- divergence


def test_a_courant_number_beyond_any_stability_is_a_divergence(make_simulation):
    simulation = make_simulation(cfl=50.0)
    with pytest.raises(
        SimulationDiverged, match=r"t = 0.04 s, particle \d+: the Courant number .*`solver.cfl`"
    ) as info:
        advanced(simulation, 1)
    assert info.value.particle is not None


def test_a_frame_of_endless_substeps_is_a_divergence(make_simulation):
    """An enormous stretch would take years of substeps; the most stretched particle is named."""
    simulation = make_simulation(wind=WindField())
    state = simulation.start()
    F = state.F_elastic.clone()
    F[12] *= 1e4
    with pytest.raises(SimulationDiverged, match=r"particle 12: a frame would take [\d,]+ substeps"):
        simulation.advance(state.replace(F_elastic=F))


# ---- camera


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
def test_the_camera_orbits_the_object_in_scene_units(up, make_cloud, make_simulation):
    cloud = make_cloud(offset=5.0)
    simulation = make_simulation(
        cloud, pinned=False, scene={"up": up, "longest_side": 0.1}, camera=OrbitCamera(radius=3.0)
    )
    low, high = cloud.means.amin(0), cloud.means.amax(0)
    eye = simulation.painter.camera_at(0).position
    assert float((eye - 0.5 * (low + high)).norm()) == pytest.approx(3 * float((high - low).amax()), rel=1e-4)


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
@pytest.mark.parametrize("flow", [[6.0, 1.5, 0.0], [0.0, 5.0, 1.0], [-3.0, -4.0, 0.0]])
def test_without_a_camera_the_wind_blows_across_a_picture_of_960_by_540(up, flow, make_cloud):
    simulation = Simulation(make_cloud(), wind=flow, up=up, device="cpu")
    camera = simulation.painter.camera_at(0)
    assert (camera.width, camera.height) == (960, 540)
    x, y, z = (camera.world_to_camera[:3, :3].double() @ simulation.scene.frame.direction_to_scene(
        double(flow))).tolist()  # fmt: skip
    speed = math.dist(flow, (0.0, 0.0, 0.0))
    assert x == pytest.approx(math.hypot(*flow[:2]), abs=1e-5 * speed)  # to the right; float32
    assert math.hypot(y, z) == pytest.approx(abs(flow[2]), abs=1e-5 * speed)


@pytest.mark.parametrize(("side", "around"), [(125.0, 40.0), (-20.0, 60.0)])
def test_without_a_camera_the_front_is_where_photos_were_taken(side, around, make_cloud, tmp_path):
    """If they are known; those from all around show no front."""
    cloud = make_cloud()
    middle = (0.5 * (cloud.means.amin(0) + cloud.means.amax(0))).tolist()

    def known(width, folder):
        views = []
        for angle in torch.linspace(side - width, side + width, 9).tolist():
            to_world = torch.linalg.inv(orbit_camera(middle, (0, 0, 1), 4.0, angle, 10.0, 40.0, 64, 36).world_to_camera)
            to_world[:, 1:3] *= -1  # as OpenGL has it
            views.append({"file_path": f"{len(views)}.png", "transform_matrix": to_world.tolist()})
        folder.mkdir()
        (folder / "transforms.json").write_text(
            json.dumps({"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 18.0, "w": 64, "h": 36, "frames": views})
        )
        cameras = {"photo": CaptureCamera(folder, view=0)}
        return Simulation(cloud, wind=[6.0, 0.0, 0.0], cameras=cameras, device="cpu").painter.camera.azimuth

    assert known(around, tmp_path / "front") == pytest.approx(side, abs=0.1)
    assert known(160.0, tmp_path / "around") == -90.0  # beside the wind


def test_a_wind_without_a_side_and_a_given_camera_leave_the_azimuth(make_cloud):
    for wind in ([0.0, 0.0, 0.0], [1.0, 0.0, 4.0]):
        simulation = Simulation(make_cloud(), wind=wind, device="cpu")
        assert simulation.painter.camera.azimuth == OrbitCamera().azimuth
    given = OrbitCamera(width=8, height=8, azimuth=12.0)
    assert Simulation(make_cloud(), wind=[4.0, 0.0, 0.0], camera=given, device="cpu").painter.camera is given


def test_a_camera_inside_the_object_is_an_error(make_cloud, make_simulation):
    inside = make_simulation(
        make_cloud(), pinned=False, camera=LookAtCamera(eye=[0.5, 0.5, 0.5], target=[2.0, 0.5, 0.5])
    )
    with value_error(r"camera at \[0.5, 0.5, 0.5\] lies inside the object"):
        inside.painter.check_camera(0)
    outside = make_simulation(
        make_cloud(), pinned=False, camera=LookAtCamera(eye=[0.5, 0.5, 3.0], target=[0.5, 0.4, 0.5])
    )
    outside.painter.check_camera(0)


# ---- colours


def _colours(simulation, state, frame=0):
    painter = simulation.painter
    return painter.colors(painter.deformed(state), painter.camera_at(frame))


def test_colours_turn_with_the_object(make_cloud, make_simulation):
    simulation = make_simulation(make_cloud(), pinned=False, scene={"up": [0.0, -1.0, 0.0], "longest_side": 0.5})
    frame, state, R = simulation.scene.frame, simulation.start(), quat_to_rotation(double([0.8, 0.3, -0.2, 0.5]))
    turned = state.replace(position=(state.position.double() @ R.T).float(), F_total=R.float().expand_as(state.F_total))
    eye = double([3.0, 1.0, -2.0])
    turned_eye = frame.point_to_scene(frame.point_to_sim(eye) @ R.T)
    target = frame.origin.tolist()

    def colours(state, eye):
        simulation.painter.camera = LookAtCamera(eye=eye.tolist(), target=target, width=32, height=18)
        return _colours(simulation, state)

    rest = colours(state, eye)
    torch.testing.assert_close(colours(turned, turned_eye), rest, rtol=0, atol=1e-5)
    assert peak(colours(turned, eye) - rest) > 0.05
    assert peak(colours(state, turned_eye) - rest) > 0.05


def test_only_moving_gaussians_are_shaded(make_cloud, make_simulation):
    cloud = make_cloud(degree=0)
    opacities = cloud.opacities.clone()
    opacities[::4] = -4.0  # faint: carried inside the region
    cloud = dataclasses.replace(cloud, opacities=opacities)
    region = up_to(x=0.5)
    settings = {"scene": {"region": region}, "pinned": False}
    plain = make_simulation(cloud, **settings)
    dark = make_simulation(cloud, shader=DiffuseShader([0.0, 0.0, 1.0]), **settings)
    before = _colours(plain, plain.start())
    gaussians, after = dark.painter.deformed(dark.start()), _colours(dark, dark.start())
    inside = cloud.means[:, 0] <= 0.5
    assert torch.equal(after[~inside], before[~inside])
    expected = before * gaussians.normals[:, 2:].clamp_min(0)  # max(0, n . L), light from above
    torch.testing.assert_close(after[inside], expected[inside], rtol=0, atol=1e-6)


def test_the_light_is_given_in_the_z_up_frame(make_simulation):
    flag = FlagScene(spacing=0.1, ripple=0.0, pattern="white").generate()
    shader = DiffuseShader([0.0, 0.0, 1.0], two_sided=True)
    for up, factor in (([0.0, 1.0, 0.0], 1.0), ([0.0, 0.0, 1.0], 0.0)):
        simulation = make_simulation(flag, shader=shader, pinned=False, scene={"up": up})
        camera = LookAtCamera(eye=[0.6, -3.0, 1.0], target=[0.6, 0.0, 0.4])
        simulation.painter.camera = camera
        colours = _colours(simulation, simulation.start())
        torch.testing.assert_close(colours, torch.full_like(colours, 0.9 * factor), rtol=0, atol=1e-5)


# ---- pictures


def test_the_first_picture_is_that_of_the_splat(flag_ply, make_simulation):
    """A file with y up and another unit, scaled to 1 m and back, against the file drawn as it is."""
    scene = Scene(ply=flag_ply, up=[0.0, 1.0, 0.0], longest_side=1.0)
    camera = LookAtCamera(eye=[7.0, -2.0, -5.0], target=[7.0, -1.7, 2.0], up=[0.0, 1.0, 0.0], width=64, height=36)
    background = (0.2, 0.3, 0.4)
    simulation = Simulation(
        scene, Material(), solver=MPMSolver(0.1), wind=[5, 0, 0], camera=camera, background=background, device="cpu"
    )
    picture = simulation.painter.render(simulation.start(), 0)
    model = GaussianSurfaceModel.from_cloud(read_ply(flag_ply), requires_grad=False)
    view = camera(0, 0.0, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), 1.0)
    colours = model.colors(normalized(model.means - view.position))
    direct = render_torch(model.means, model.covariance(), model.opacity(), colours, view, torch.tensor(background))
    assert direct.alpha.mean() > 0.1  # the flag is in the picture
    error = float((picture.color - direct.color).square().mean())
    assert -10 * math.log10(max(error, 1e-12)) >= 35
    state, _ = advanced(simulation, 3)
    moved = simulation.painter.render(state, 0)
    assert (moved.color - direct.color).square().mean() > 100 * max(error, 1e-12)


PICTURES = {
    "plain": (None, {}),
    "diffuse": (DiffuseShader([1.0, 0.5, 1.0], relative=True), {}),
    "relative": (
        DiffuseShader([1.0, 0.5, 1.0], two_sided=True, ambient=0.3, relative=True),
        {"up": [0.0, -1.0, 0.0]},
    ),
    "part": (DiffuseShader(ambient=0.3), {"region": up_to(x=0.6), "up": [0.3, 1.0, 0.0]}),
}


@pytest.mark.parametrize("shader", [None, DiffuseShader()], ids=["plain", "diffuse"])
@pytest.mark.parametrize("degree", [0, 3])
def test_many_still_gaussians_are_coloured_once(degree, shader, make_cloud, make_simulation, monkeypatch):
    part = {"region": up_to(x=0.6)}
    cloud = make_cloud(degree=degree)
    simulation = make_simulation(cloud, pinned=False, shader=shader, scene=part)
    painter, state = simulation.painter, simulation.start()
    assert 0 < len(simulation.scene.moving) < len(cloud)
    seen = []
    near = painter.camera_at(0)
    cameras = [near, replace(near, world_to_camera=near.world_to_camera + torch.eye(4)[2:3].T * torch.eye(4)[3] * 0.7)]
    for _ in range(2):
        gaussians = painter.deformed(state)
        for camera in cameras:
            expected = painter.colors(gaussians, camera)
            with monkeypatch.context() as patch:
                patch.setattr("gaussian_swaying.simulation.draw.RECORDED", 7)
                for _ in range(2):
                    torch.testing.assert_close(painter.colors(gaussians, camera), expected, rtol=0, atol=1e-6)
                    assert painter._rest[0] is camera
        seen.append(expected)
        state = simulation.edit(simulation.advance(state)[0], Edit(color=[0.9, 0.1, 0.1]))
    assert peak(seen[0] - seen[1]) > 0.1  # the edit was seen


@pytest.fixture
def many_still(make_cloud, make_simulation, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.simulation.draw.RECORDED", 7)
    part = {"region": up_to(x=0.6)}
    return lambda: make_simulation(make_cloud(degree=1), pinned=False, scene=part)


@pytest.mark.parametrize("changed", ["means", "camera"])
def test_kept_colours_follow_a_change_in_place(changed, many_still):
    painter = many_still().painter
    gaussians, camera = painter.scene.rest(), painter.camera_at(0)
    camera = replace(camera, world_to_camera=camera.world_to_camera.clone())
    before = painter.colors(gaussians, camera)
    with torch.no_grad():
        if changed == "means":
            painter.scene.model.means[:, 2] += 3.0
        else:
            camera.world_to_camera[1, 3] += 3.0
    after = painter.colors(painter.scene.rest(), camera)
    painter._rest = None
    assert torch.equal(after, painter.colors(painter.scene.rest(), camera))
    assert not torch.allclose(before, after)


def test_harmonics_of_still_gaussians_have_gradients(many_still):
    painter = many_still().painter
    gaussians, camera, model = painter.scene.rest(), painter.camera_at(0), painter.scene.model
    kept = painter.colors(gaussians, camera)
    model.sh0.requires_grad_(True)
    found = painter.colors(gaussians, camera)
    found.sum().backward()
    assert torch.equal(found, kept)
    assert (model.sh0.grad != 0).any(-1).all()


def test_colours_of_a_run_that_was_made_in_inference_mode(many_still):
    with torch.inference_mode():
        painter = many_still().painter
        inside = painter.colors(painter.scene.rest(), painter.camera_at(0))
    model = painter.scene.model
    with torch.inference_mode():
        model.sh0.mul_(2.0)
    outside = painter.colors(painter.scene.rest(), painter.camera_at(0))
    assert peak(outside - inside) > 0.01


def _on_gpu(simulation):
    simulation.to("cuda")
    simulation.painter.renderer = make_renderer("cuda")
    return simulation


@pytest.mark.gpu
@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("degree", [0, 3])
def test_a_picture_never_makes_the_host_wait(name, degree, make_cloud, make_simulation, monkeypatch):
    gsplat = pytest.importorskip("gsplat")
    shader, settings = PICTURES[name]
    camera = OrbitCamera(width=64, height=36, degrees_per_second=100.0)
    simulation = make_simulation(make_cloud(degree=degree), pinned=False, shader=shader, scene=settings, camera=camera)
    simulation = _on_gpu(simulation)
    if not isinstance(simulation.painter.renderer, GsplatRenderer):
        pytest.skip("gsplat cannot compile its kernels here")
    state, isect_tiles = simulation.start(), gsplat.isect_tiles

    def let_wait(*arguments, **options):
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("default")
        try:
            return isect_tiles(*arguments, **options)
        finally:
            torch.cuda.set_sync_debug_mode(mode)

    monkeypatch.setattr(gsplat, "isect_tiles", let_wait)
    for frame in range(2):
        simulation.painter.render(state, frame)
    with without_waits():
        pictures = [simulation.painter.render(state, frame) for frame in (2, 3)]
    assert pictures[0].alpha.mean() > 0.01
    assert not torch.equal(pictures[0].color, pictures[1].color)


@pytest.mark.gpu
@pytest.mark.parametrize("name", PICTURES)
def test_a_gpu_shades_as_the_cpu_does(name, make_cloud, make_simulation):
    shader, settings = PICTURES[name]
    cloud = make_cloud(degree=3)
    F = torch.eye(3) + 0.3 * torch.rand(40, 3, 3, generator=seeded(3))
    shaded = []
    for place in ("cpu", "cuda"):
        simulation = make_simulation(cloud, pinned=False, shader=copy.deepcopy(shader), scene=settings)
        simulation = _on_gpu(simulation) if place == "cuda" else simulation
        state = simulation.start()
        state = state.replace(position=1.1 * state.position, F_total=F[: len(state.position)].to(place))
        gaussians, colours = simulation.painter.deformed(state), _colours(simulation, state, 1)
        shaded.append([colours, *(getattr(gaussians, n) for n in ("means", "covariances", "normals", "rotations"))])
    for ours, theirs in zip(*shaded, strict=True):
        torch.testing.assert_close(theirs.cpu(), ours, rtol=1e-4, atol=1e-5)
