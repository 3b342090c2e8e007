"""``scene.points: grid``: as many points as the grid can use, and all Gaussians follow its nodes."""

import dataclasses
import math

import pytest
import torch
from shared import advanced, beyond, peak, rand, randn, seeded, up_to, value_error

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.mpm.laws.elastic import NeoHookean
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.simulation.body import Material, MaterialRegion, Scene, SimulatedScene, matched_points
from gaussian_swaying.simulation.measure import measure
from gaussian_swaying.simulation.model import Edit
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

HALF = beyond(x=0.0451)


def fine_flag(spacing=0.02):
    cloud = FlagScene(spacing=spacing).generate()
    cloud.opacities[::7] = -6.0  # some are faint
    return cloud


def both(make_scene, **settings):
    return (make_scene(fine_flag(), dx=0.15, points=points, **settings) for points in ("gaussian", "grid"))


@pytest.mark.parametrize("per_cell", [1, 2, 3])
def test_mass_centre_volume_and_area_are_kept_by_few_points(per_cell, make_scene):
    full, scene = both(make_scene, dtype=torch.float64, points_per_cell=per_cell)
    assert torch.equal(scene.simulated, full.simulated)
    assert scene.points.count < len(full.simulated) / 2 * (2 / per_cell) ** 2
    for name in ("mass", "volume"):
        torch.testing.assert_close(getattr(scene.points, name).sum(), getattr(full.points, name).sum())
    centre = [(s.points.mass[:, None] * s.points.position).sum(0) / s.points.mass.sum() for s in (scene, full)]
    torch.testing.assert_close(*centre, rtol=0, atol=1e-12)
    torch.testing.assert_close(scene.patches.area.sum(), full.patches.area.sum())
    for k in range(scene.points.count if per_cell != 2 else 0):  # and by each group
        own = scene.owner[: len(scene.simulated)] == k
        torch.testing.assert_close(scene.points.mass[k], full.points.mass[own].sum())
    everyone = torch.cat([scene.simulated, scene.carried]).sort().values
    assert torch.equal(everyone, torch.arange(len(scene.model.means)))


@pytest.mark.parametrize(
    ("sizes", "count"),
    [
        ([1.0, 0.5, 0.3], 8),
        ([1.0, 0.5, 0.1], 8),
        ([1.0, 0.5, 0.0], 4),
        ([1.0, 0.0, 0.0], 2),
        ([0.0, 0.0, 0.0], 1),
    ],
)
def test_points_of_a_group_have_its_moments(sizes, count):
    generator = seeded(0)
    place = randn(600, 3, generator=generator) * torch.tensor(sizes)
    place = place @ torch.linalg.qr(randn(3, 3, generator=generator))[0]
    mass = rand(600, generator=generator)
    group = torch.randint(0, 5, (600,), generator=generator)
    points, owner, of = matched_points(place, mass, group, torch.full((5,), True), 1.0)
    assert torch.equal(of[owner], group)
    assert len(points) == 5 * count
    for k in range(5):
        own, x = mass[group == k], place[group == k]
        centre = (own[:, None] * x).sum(0) / own.sum()
        torch.testing.assert_close(points[of == k].mean(0), centre)
        expected = ((x - centre) * own[:, None]).mT @ (x - centre) / own.sum()
        arm = points[of == k] - centre
        torch.testing.assert_close(arm.mT @ arm / len(arm), expected, rtol=0, atol=1e-12)
        near = torch.cdist(x, points[of == k]).argmin(-1) == owner[group == k] - owner[group == k].min()
        assert count == 1 or float(near.double().mean()) > 0.9
    single, _, _ = matched_points(place, mass, group, torch.full((5,), False), 1.0)
    assert len(single) == 5


def test_groups_do_not_cross_borders(make_scene):
    stiff = MaterialRegion(HALF, E=9e4, law=NeoHookean())
    edge, corner = up_to(x=0.031), beyond(z=0.3051)
    scene = SimulatedScene(
        Scene(generator=FlagScene(spacing=0.02)), Material(regions=[stiff]), 0.15, apart=(edge, corner)
    )
    means = scene.model.means[scene.simulated]
    for region in (HALF, edge, corner):
        inside = region.contains(means)
        assert inside.any()
        of_points = region.contains(scene.frame.point_to_scene(scene.points.position.double()))
        assert torch.equal(of_points[scene.owner], inside)
    assert torch.equal(scene.points.youngs_modulus[scene.owner] == 9e4, HALF.contains(means))
    assert torch.equal(scene.points.law_index[scene.owner] == 1, HALF.contains(means))
    plain = SimulatedScene(Scene(generator=FlagScene(spacing=0.02)), Material(), 0.15)
    assert scene.points.count > plain.points.count


def test_a_group_whose_centre_leaves_its_region_is_not_made(make_scene):
    """What lies around a thin region would have its centre in it."""
    ring = Box([None, None, -0.005], [None, None, 0.005])
    scene = SimulatedScene(Scene(generator=FlagScene(spacing=0.01)), Material(), 0.3, apart=(ring,))
    inside = ring.contains(scene.frame.point_to_scene(scene.points.position.double()))[scene.owner]
    assert torch.equal(inside, ring.contains(scene.model.means))


def test_regions_of_pins_and_edits_reach_the_scene(make_simulation):
    edit = Edit(region=HALF, E=1e4)
    simulation = make_simulation(cloud=fine_flag(), dx=0.15, scene={"points": "grid"}, parts={"edits": [edit]})
    scene = simulation.scene
    own = scene.owner[: len(scene.simulated)]
    for region in (HALF, simulation.solver.boundaries[0].region):
        inside = region.contains(scene.frame.point_to_scene(scene.points.position.double()))
        assert torch.equal(inside[own], region.contains(scene.model.means[scene.simulated]))


def test_everything_follows_a_linear_motion_and_stays_at_rest(make_scene):
    scene = make_scene(fine_flag(), dx=0.15, points="grid", up=[0.0, -1.0, 0.0], metres_per_unit=0.5)
    state = MPMSolver(0.15).init_state(scene.points)
    assert torch.equal(scene.deformed(state).means, scene.rest().means)
    assert torch.equal(scene.surface(state)[0], scene.track.place)
    F = torch.tensor([[1.1, 0.2, 0.0], [0.0, 0.9, 0.3], [-0.1, 0.0, 1.0]])
    nodes = state.grid.node_positions(F)
    moved = state.replace(node_displacement=nodes @ F.T - nodes, node_velocity=nodes)
    found = scene.deformed(moved)
    expected = scene.frame.point_to_scene(scene.frame.point_to_sim(scene.model.means.double()) @ F.double().T)
    torch.testing.assert_close(found.means.double(), expected, atol=1e-5, rtol=0)
    turn = scene.frame.gradient_to_scene(F)
    torch.testing.assert_close(found.covariances, turn @ scene.rest_covariances @ turn.T, atol=1e-7, rtol=1e-4)
    torch.testing.assert_close(scene.surface(moved)[0], scene.track.place @ F.T, atol=1e-5, rtol=0)
    torch.testing.assert_close(scene.follow.velocity(moved), scene.follow.place, atol=1e-5, rtol=0)


def test_no_gaussian_follows_a_node_without_mass(make_cloud):
    cloud = make_cloud(3000)
    cloud = dataclasses.replace(cloud, scales=cloud.scales - 4 * torch.rand(3000, 1))
    dx = 0.11
    scene = SimulatedScene(Scene(generator=GivenScene(cloud), points="grid"), Material(), dx)
    solver = MPMSolver(dx)
    state = solver.init_state(scene.points)
    shift = torch.where(solver.bound.node_mass[:, None] > 0, torch.tensor([0.3, -0.2, 0.1]), 0.0)
    moved = scene.deformed(state.replace(node_displacement=shift)).means - scene.rest().means
    torch.testing.assert_close(moved, torch.tensor([0.3, -0.2, 0.1]).expand_as(moved), rtol=0, atol=1e-5)


def test_it_moves_as_with_all_points(make_simulation):
    """A flag of 16 Gaussians a cell: half a second of wind, within 3 % of the distance moved."""
    ends = {}
    for points in ("gaussian", "grid"):
        simulation = make_simulation(
            cloud=FlagScene(spacing=0.03).generate(), dx=0.12, aero=AeroForce(law="projected"), scene={"points": points}
        )
        with torch.inference_mode():
            state, _ = advanced(simulation, 12)
            ends[points] = simulation.scene.deformed(state).means - simulation.scene.rest().means
    moved = ends["gaussian"].norm(dim=-1)
    assert moved.max() > 0.1
    assert (ends["grid"] - ends["gaussian"]).norm(dim=-1).mean() < 0.03 * moved.mean()


def test_holes_get_further_points(make_scene):
    """Gaussians three cells apart, each as wide: without further points they would hang on nothing."""
    few = FlagScene(spacing=0.3).generate()
    scene = make_scene(few, dx=0.1, points="grid")
    assert scene.further > 50
    where = scene.points.position[:, ::2]
    inner = torch.cartesian_prod(torch.linspace(-0.4, 0.4, 30), torch.linspace(-0.2, 0.2, 20))
    assert torch.cdist(inner, where).amin(1).max() < 0.1  # no cell of the flag is empty
    dense = make_scene(FlagScene(spacing=0.04).generate(), dx=0.1, points="grid")
    assert dense.further == 0
    assert make_scene(few, dx=0.1, points="grid", particle_spacing=0.02).further > 2 * scene.further


def test_three_layers_share_the_normal_of_their_group(make_scene):
    """The faces lie on both sides of the middle plane, though the normals of the Gaussians have any sign."""
    cloud = FlagScene(spacing=0.02, ripple=0.0).generate()
    half = math.pi * (torch.arange(len(cloud)) % 2)  # half of them turned upside down about x
    w, x, y, z = cloud.quats.unbind(-1)
    c, s = (half / 2).cos(), (half / 2).sin()
    turned = torch.stack([w * c - x * s, w * s + x * c, y * c + z * s, z * c - y * s], -1)
    cloud = dataclasses.replace(cloud, quats=turned)
    scene = make_scene(cloud, Material(thickness=0.02), dx=0.15, points="grid", layers=3)
    assert float(scene.rest_normals[0] @ scene.rest_normals[1]) < -0.99
    count = scene.on_surface
    assert scene.points.count == 3 * count
    height = scene.points.position[count:, 1].abs()
    torch.testing.assert_close(height, torch.full_like(height, 0.01), rtol=1e-3, atol=0)
    torch.testing.assert_close(scene.points.volume[count:], scene.points.volume[:count].repeat(2) / 4)


def test_a_solid_is_grouped_too():
    settings = {
        "generator": SolidScene(shape="ball", size=0.6, spacing=0.03, gaussians="shell"),
        "filling": InteriorFilling(),
    }
    full, scene = (SimulatedScene(Scene(points=p, **settings), Material(), 0.12) for p in ("gaussian", "grid"))
    assert scene.points.count < 0.7 * full.points.count
    assert scene.filled > 0
    torch.testing.assert_close(scene.points.mass.sum(), full.points.mass.sum())
    torch.testing.assert_close(scene.patches.area.sum(), full.patches.area.sum())
    assert int(scene.patches.point.max()) < scene.on_surface


def test_the_force_is_known_for_every_gaussian(make_simulation):
    found = {}
    for points in ("gaussian", "grid"):
        simulation = make_simulation(cloud=fine_flag(), dx=0.15, scene={"points": points})
        found[points] = simulation.stepper.wind_pressure(simulation.start())
    torch.testing.assert_close(found["grid"], found["gaussian"])
    assert found["grid"].amin() > 0


def test_the_default_is_the_grid_where_it_is_possible(make_simulation):
    cloud = FlagScene(spacing=0.03).generate()
    for formulation, few in (("total", True), ("updated", False)):
        simulation = make_simulation(cloud=cloud, scene={"points": None}, formulation=formulation)
        assert (simulation.scene.points.count < len(cloud)) is few
    with value_error(r"`scene.points: grid` needs `solver.formulation: total`"):
        make_simulation(cloud=cloud, scene={"points": "grid"}, formulation="updated")


@pytest.mark.parametrize(
    ("kernel_device", "up"),
    [
        ("cpu", [0.0, -1.0, 0.2]),
        ("cpu", [0.0, 0.0, 1.0]),
        pytest.param("cuda", [0.0, -1.0, 0.2], marks=pytest.mark.gpu),
        pytest.param("cuda", [0.0, 0.0, 1.0], marks=pytest.mark.gpu),
    ],
    indirect=["kernel_device"],
)
def test_the_kernel_of_embedded_points_is_their_definition(up, kernel_device, make_scene):
    """With arms (of faint ones), rotations and the limit of the stretch, and without."""
    if INTERPRETED:
        pytest.skip("the interpreter takes too long to replace torch")
    for region, stretch in ((None, 1.05), (HALF, None)):
        scene = make_scene(
            fine_flag(0.04), dx=0.15, points="grid", up=up, metres_per_unit=0.5, region=region, max_stretch=stretch
        )
        scene = scene.to(kernel_device)
        assert scene.follow.arm is not None
        state = MPMSolver(0.15).init_state(scene.points)
        nodes = 0.02 * torch.randn(state.node_displacement.shape, generator=seeded(1))
        state = state.replace(node_displacement=nodes.to(kernel_device))
        own = [part[scene.moving] for part in (scene.model.means.detach(), scene.rest_covariances, scene.rest_normals)]
        solid = None if stretch is None else torch.ones(len(scene.moving), dtype=torch.bool, device=kernel_device)
        move, F = scene.follow.motion(state)
        F = scene.frame.gradient_to_scene(F)
        rest = (part.double() for part in own[1:])
        shapes = deform_all(F.double(), *rest, True, stretch, solid)
        expected = (own[0] + scene.frame.displacement_to_scene(move), *shapes)
        found = scene.follow.drawn(state, scene.frame, *own, True, stretch, solid)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a.double(), b.double(), rtol=1e-4, atol=2e-5 * float(peak(b)))
        drawn, still = scene.deformed(state), scene.deformed(MPMSolver(0.15).init_state(scene.points))
        torch.testing.assert_close(drawn.means[scene.moving], found[0])
        torch.testing.assert_close(drawn.covariances[scene.moving], found[1])
        assert torch.equal(still.means, scene.rest().means)


@pytest.mark.parametrize("law", ["paper", "projected", "linear"])
def test_points_of_a_group_share_its_wind(law, make_scene):
    """On an oblique sheet, wind and mass of the points have one ratio, and the whole wind is that on the Gaussians."""
    cloud = FlagScene(spacing=0.01, yaw=-35.0, ripple=0.0).generate()
    full, scene = (make_scene(cloud, dx=0.1, points=points, dtype=torch.float64) for points in ("gaussian", "grid"))
    ratio = scene.patches.areas() / scene.points.mass
    torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-5, atol=0)
    forces = []
    for one in (full, scene):
        state = MPMSolver(0.1).init_state(one.points)
        forces.append(WindForce(AeroForce(law=law), WindField([3.0, 1.0, 0.5]), one.patches)(state)[0].sum(0))
    torch.testing.assert_close(*forces, rtol=1e-3, atol=1e-6)


def test_a_coarse_splat_keeps_its_gaussians(make_scene):
    scene = make_scene(FlagScene(spacing=0.05).generate(), dx=0.1, points="grid")
    assert scene.points.count == len(scene.simulated)
    torch.testing.assert_close(scene.points.position[scene.owner], scene.follow.place)


def test_a_single_gaussian():
    one = FlagScene(spacing=0.5).generate().select(torch.tensor([0]))
    cloud = GaussianCloud(one.means, one.quats, one.scales - 3, one.opacities, one.sh)
    scene = SimulatedScene(Scene(generator=GivenScene(cloud)), Material(), 0.5)
    assert scene.points.count == 1
    assert torch.equal(scene.points.position.double(), scene.frame.point_to_sim(cloud.means.double()).float().double())


@pytest.mark.gpu
def test_recorded_measurements_are_those_of_the_frame(make_simulation):
    simulation = make_simulation(cloud=fine_flag(), dx=0.15, scene={"points": "grid"}).to("cuda")
    with torch.inference_mode():
        state = simulation.start()
        for k in range(5):
            if k == 3:
                state = simulation.edit(state, Edit(density=50.0))
            end, found = simulation.advance(state)
            steps = found.substeps
            expected = measure(simulation.solver, end, steps, found.cfl, None, state).read()
            assert found.as_dict() == pytest.approx(expected.as_dict(), rel=1e-6)
            state = end
    assert any(simulation.stepper._gauge.replayed._repeater._graphs.values())
