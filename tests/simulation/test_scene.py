import dataclasses
import math

import pytest
import torch
from shared import EYE, double, near, seeded, silent, up_to, user_warning, value_error
from small_scenes import together

from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_from_z, rotation_to_quat
from gaussian_swaying.mpm.laws.elastic import FixedCorotated, NeoHookean, StVKHencky
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation import body
from gaussian_swaying.simulation.body import Material, MaterialRegion, Scene, SimulatedScene, cell_volume
from gaussian_swaying.simulation.model import Edit

LEFT = up_to(x=0.5)
UPS = [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.3, -0.7, 0.2]]


def _rest_state(scene):
    return MPMSolver(0.25).init_state(scene.points)


def _faint_cloud(make_cloud):
    cloud = make_cloud()
    opacities = cloud.opacities.clone()
    opacities[1::2] = math.log(0.05 / 0.95)
    return dataclasses.replace(cloud, opacities=opacities)


def test_the_region_chooses_and_the_rest_stays(make_cloud, make_scene):
    cloud = make_cloud()
    scene = make_scene(cloud, region=LEFT)
    inside = cloud.means[:, 0] <= 0.5
    assert 0 < int(inside.sum()) < len(cloud)
    assert torch.equal(scene.simulated, inside.nonzero()[:, 0])
    assert scene.points.count == int(inside.sum())
    assert len(scene.model.means) == len(cloud)
    state = _rest_state(scene)
    moved = scene.deformed(state.replace(position=state.position + 0.3, F_total=state.F_total * 1.5))
    for name in ("means", "covariances", "normals", "rotations"):
        assert torch.equal(getattr(moved, name)[~inside], getattr(scene.rest(), name)[~inside]), name
    torch.testing.assert_close(moved.means[inside], cloud.means[inside] + 0.3)


@pytest.mark.parametrize("faint", ["carry", "static", "drop"])
def test_faint_gaussians(faint, make_cloud, make_scene):
    cloud = _faint_cloud(make_cloud)
    scene = make_scene(cloud, faint=faint)
    assert scene.points.count == 20
    assert len(scene.model.means) == (20 if faint == "drop" else 40)
    state = _rest_state(scene)
    means = scene.deformed(state.replace(position=state.position + 1.0)).means
    expected = cloud.means + 1.0
    if faint == "static":
        expected[1::2] = cloud.means[1::2]
    torch.testing.assert_close(means, expected[::2] if faint == "drop" else expected)


def test_faint_gaussians_outside_the_region_stay(make_cloud, make_scene):
    cloud = _faint_cloud(make_cloud)
    outside = cloud.means[:, 0] > 0.5
    for faint, count in (("carry", 40), ("drop", 40 - int((~outside)[1::2].sum()))):
        scene = make_scene(cloud, faint=faint, region=LEFT)
        assert len(scene.model.means) == count
        assert not (scene.model.means[scene.carried, 0] > 0.5).any()


def test_carried_gaussians_follow_their_nearest_particle(make_cloud, make_scene):
    """x' = x_a' + F_a (x - x_a), with a covariance and normal of F_a; every particle has its own F."""
    cloud = _faint_cloud(make_cloud)
    scene = make_scene(cloud)
    state = _rest_state(scene)
    F = torch.eye(3) + 0.3 * torch.rand(20, 3, 3, generator=seeded(3))
    shift = torch.rand(20, 3, generator=seeded(4))
    deformed = scene.deformed(state.replace(position=state.position + shift, F_total=F))
    for k, index in enumerate(scene.carried.tolist()):
        particle = int((cloud.means[::2] - cloud.means[index]).norm(dim=-1).argmin())
        assert int(scene.owner[len(scene.simulated) + k]) == particle
        arm = cloud.means[index] - cloud.means[2 * particle]
        torch.testing.assert_close(deformed.means[index], deformed.means[2 * particle] + F[particle] @ arm)
        covariance = F[particle] @ scene.rest_covariances[index] @ F[particle].T
        torch.testing.assert_close(deformed.covariances[index], covariance)


@pytest.mark.parametrize("up", UPS)
def test_nothing_moves_at_rest(up, make_cloud, make_scene):
    """Bit for bit, whatever the axes and the unit, carried Gaussians included."""
    cloud = _faint_cloud(make_cloud)
    cloud.means[1::2] *= 7.3  # arms that do not round to nothing
    scene = make_scene(cloud, up=up, longest_side=0.37)
    for formulation in ("total", "updated"):
        deformed = scene.deformed(MPMSolver(0.25, formulation).init_state(scene.points))
        assert torch.equal(deformed.means, scene.model.means)
        assert torch.equal(deformed.covariances, scene.rest_covariances)
        near(deformed.normals, scene.rest_normals, 1e-6)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("settings", [{}, {"region": LEFT}, {"region": LEFT, "opacity_threshold": 0.0}])
def test_rotations_are_left_out_where_nobody_asks(up, settings, make_cloud, make_scene):
    scene = make_scene(_faint_cloud(make_cloud) if settings else None, up=up, **settings)
    assert scene.all_move == (not settings)
    assert torch.equal(scene.moving, torch.cat([scene.simulated, scene.carried]))
    facing = scene.frame.direction_to_sim(scene.rest_normals[scene.moving])
    torch.testing.assert_close(scene.rest_facing, facing)
    state = _rest_state(scene)
    F = torch.eye(3) + 0.3 * torch.rand(scene.points.count, 3, 3, generator=seeded(3))
    state = state.replace(position=state.position + 0.2, F_total=F)
    full, plain = scene.deformed(state), scene.deformed(state, rotations=False)
    for name in ("means", "covariances", "normals"):
        assert torch.equal(getattr(full, name), getattr(plain, name)), name
        assert not torch.equal(getattr(full, name), getattr(scene.rest(), name)), name
    assert torch.equal(plain.rotations, scene.rest().rotations)
    turned = polar_rotation(scene.frame.gradient_to_scene(F))
    torch.testing.assert_close(full.rotations[scene.simulated], turned)
    assert not torch.equal(full.rotations, plain.rotations)


@pytest.mark.parametrize("up", UPS)
def test_a_rigid_motion_moves_everything_rigidly(up, make_cloud, make_scene):
    scene = make_scene(_faint_cloud(make_cloud), up=up, longest_side=0.5, dtype=torch.float64)
    state, frame = _rest_state(scene), scene.frame
    R, shift = quat_to_rotation(double([0.3, -0.5, 0.7, 0.2])), double([0.2, -0.1, 0.4])
    F = R.expand(20, 3, 3)
    deformed = scene.deformed(state.replace(position=state.position @ R.T + shift, F_total=F, F_elastic=F))
    turn = (frame.rotation.T @ R @ frame.rotation).float()
    rest = scene.rest()
    expected = frame.point_to_scene(frame.point_to_sim(rest.means.double()) @ R.T + shift).float()
    near(deformed.means, expected, 2e-6)
    near(deformed.covariances, turn @ rest.covariances @ turn.T, 1e-7)
    near(deformed.normals, rest.normals @ turn.T, 1e-6)
    near(deformed.rotations, turn.expand(40, 3, 3), 1e-6)


def test_normals_of_a_shear_are_not_those_of_its_rotation(make_scene):
    """F⁻ᵀN: a sheet in the x-z plane sheared by y += x has the normal (-1, 1, 0) / sqrt 2."""
    scene = make_scene(FlagScene(spacing=0.2, ripple=0.0).generate())
    state = _rest_state(scene)
    F = torch.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).expand_as(state.F_total)
    normals = scene.deformed(state.replace(F_total=F)).normals
    expected = torch.tensor([-1.0, 1.0, 0.0]) / math.sqrt(2)
    torch.testing.assert_close((normals @ expected).abs(), torch.ones(len(normals)))


@pytest.mark.parametrize("settings", [{}, {"region": LEFT}])
def test_gaussians_keep_to_the_stretch_of_the_scene(settings, make_cloud, make_scene):
    """Whether all of them move or some, carried ones included; without a limit they follow F however far."""
    cloud = _faint_cloud(make_cloud) if settings else None
    free, limited = (make_scene(cloud, max_stretch=stretch, **settings) for stretch in (None, 1.5))
    state = _rest_state(free)
    F = torch.eye(3).repeat(free.points.count, 1, 1)
    F[::2, 0, 1] = 1e3
    state = state.replace(F_total=F)
    rest = free.rest_covariances
    drawn, kept = free.deformed(state).covariances, limited.deformed(state).covariances
    growth = (kept.diagonal(dim1=-2, dim2=-1).sum(-1) / rest.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt()
    assert float(growth.max()) == pytest.approx(1.5, rel=1e-4)
    assert torch.equal(limited.deformed(_rest_state(limited)).covariances, rest)
    still = growth < 1.0001
    assert torch.equal(kept[still], drawn[still])


def test_what_is_torn_is_drawn_as_a_patch_of_a_solid_and_as_a_grain_of_sand(make_scene):
    sheet = FlagScene(spacing=0.2, ripple=0.0).generate()
    material = Material(regions=[MaterialRegion(LEFT, law=Sand(35.0))])
    solid, mixed, free = make_scene(sheet), make_scene(sheet, material), make_scene(sheet, max_stretch=None)
    state = _rest_state(solid)
    F = torch.eye(3).repeat(solid.points.count, 1, 1)
    F[:, 0, 0] = 1.99
    state = state.replace(F_total=F)
    assert torch.equal(solid.deformed(state).covariances, free.deformed(state).covariances)
    F = F.clone()
    F[:, 0, 0] = 30.0
    state = state.replace(F_total=F)
    flat = 0.012**2  # of the thin axis: a tenth of 0.6 times the spacing
    sand = LEFT.contains(sheet.means)
    assert 0 < int(sand.sum()) < len(sand)
    assert float(free.deformed(state).covariances[:, 0, 0].max()) == pytest.approx(900 * 0.12**2, rel=1e-3)
    for scene, grains in ((solid, torch.zeros_like(sand)), (mixed, sand)):
        kept = scene.deformed(state).covariances
        assert kept[:, 0, 0].max() < 8 * 0.12**2
        torch.testing.assert_close(kept[~grains, 1, 1], torch.full_like(kept[~grains, 1, 1], flat), rtol=0.01, atol=0)
        if bool(grains.any()):
            assert kept[grains, 1, 1].min() > 0.5 * 0.12**2
    mixed.points = solid.points  # as an edit does it
    assert torch.equal(mixed.deformed(state).covariances, solid.deformed(state).covariances)


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.5])
def test_a_patch_weighs_density_times_area_times_thickness(make_scene, metres_per_unit):
    material = Material(density=30.0, thickness=0.02)
    flag = FlagScene(spacing=0.1, ripple=0.0).generate()
    scene = make_scene(flag, material, metres_per_unit=metres_per_unit)
    torch.testing.assert_close(scene.points.volume, scene.patches.areas() * 0.02)
    torch.testing.assert_close(scene.points.mass, scene.points.volume * 30.0)
    weight = 1.2 * 0.8 * metres_per_unit**2 * 0.02 * 30.0
    assert float(scene.points.mass.sum()) == pytest.approx(weight, rel=0.02)


def test_faint_gaussians_take_no_area(make_cloud, make_scene):
    """The surface belongs to those that carry it, so its weight does not depend on what is filtered out."""
    flag = FlagScene(spacing=0.1, ripple=0.0).generate()
    haze = dataclasses.replace(flag, means=flag.means + 0.01, opacities=torch.full((96,), -5.0))
    torch.testing.assert_close(make_scene(together(flag, haze)).patches.area, make_scene(flag).patches.area)


def test_each_part_has_the_law_it_was_given(make_cloud, make_scene):
    cloud = make_cloud()
    material = Material(law=NeoHookean(), regions=[MaterialRegion(LEFT, law=Sand(35.0)), MaterialRegion(LEFT, E=7.0)])
    points = make_scene(cloud, material).points
    inside = cloud.means[:, 0] <= 0.5
    assert [type(law).__name__ for law in points.laws] == ["NeoHookean", "Sand"]
    assert torch.equal(points.law_index, inside.long())
    assert points.laws[1].friction_angle == 35.0
    plain = make_scene(cloud, Material()).points
    assert plain.law_index is None
    assert [type(law).__name__ for law in plain.laws] == ["FixedCorotated"]
    # moving the scene to another type keeps the integers
    assert make_scene(cloud, material).to(torch.float64).points.law_index.dtype == torch.long


def test_simulations_of_the_same_gaussians_compute_their_areas_once(make_cloud, make_scene, monkeypatch):
    """Whatever else differs; they are the same as on their own, and nobody changes those of another."""
    asked, cloud = [], make_cloud()
    compute = body.coverage_area
    monkeypatch.setattr(body, "coverage_area", lambda *given: asked.append(1) or compute(*given))
    body._last.clear()
    first, second = (make_scene(cloud, Material(E=E)) for E in (1e5, 2e5))
    assert len(asked) == 1
    assert torch.equal(first.patches.area, second.patches.area)
    first.patches.area.zero_()
    assert (make_scene(cloud).patches.area > 0).all()
    cloud.opacities[3] -= 1
    make_scene(cloud)
    make_scene(cloud, area="open")
    assert len(asked) == 3


def test_areas_as_in_the_paper_and_equal_ones(make_cloud, make_scene):
    cloud = make_cloud()
    s = cloud.scales.exp().sort(dim=-1).values
    scene = make_scene(cloud, area="paper", metres_per_unit=2.0)
    torch.testing.assert_close(scene.patches.area, 4 * math.pi * s[:, 1] * s[:, 2])
    equal, covered = (make_scene(cloud, area=area).patches.area for area in ("equal", "coverage"))
    torch.testing.assert_close(equal, covered.mean().expand_as(equal))


def test_cell_rule(make_scene):
    position = torch.tensor([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [0.4, 0.4, 0.4], [-0.1, 0.1, 0.1]])
    torch.testing.assert_close(cell_volume(position, 0.5), torch.tensor([1, 1, 1, 3]) * 0.125 / 3)
    scene = make_scene(material=Material(volume="cell", density=10.0), dx=0.25)
    torch.testing.assert_close(scene.points.volume, cell_volume(scene.points.position, 0.25))
    torch.testing.assert_close(scene.points.mass, 10 * scene.points.volume)


def test_material_regions(make_cloud, make_scene):
    material = Material(
        E=1e4,
        nu=0.2,
        density=100.0,
        thickness=0.01,
        regions=[
            MaterialRegion(LEFT, E=2e4, nu=0.4, density=50.0, thickness=0.03),
            MaterialRegion(up_to(x=0.25), E=3e4),
        ],
    )
    cloud = make_cloud()
    scene = make_scene(cloud, material, dtype=torch.float64)
    x, points = cloud.means[:, 0], scene.points
    left, far_left = x <= 0.5, x <= 0.25
    assert bool(far_left.any()) and bool((left & ~far_left).any())  # noqa: PT018

    def field(outside, inside, further):
        values = torch.full((len(cloud),), outside, dtype=torch.float64)
        values[left] = inside
        values[far_left] = further
        return values

    assert torch.equal(points.youngs_modulus, field(1e4, 2e4, 3e4))
    assert torch.equal(points.poisson_ratio, field(0.2, 0.4, 0.4))
    torch.testing.assert_close(points.mass / points.volume, field(100.0, 50.0, 50.0))
    torch.testing.assert_close(points.volume / scene.patches.area, field(0.01, 0.03, 0.03))


TOP = Box([None, None, 0.55], [None, None, 0.75])  # of a flag with z up


@pytest.mark.parametrize("what", ["scene", "boundary", "material", "edits"])
@pytest.mark.parametrize("far", [False, True])
def test_a_region_in_the_axes_of_the_wind_says_so(what, far, make_simulation):
    cloud, up = FlagScene(spacing=0.1).generate(), [0.0, -1.0, 0.0]
    means = cloud.means @ rotation_from_z(up).T.to(cloud.means)
    region = Box([5.0, 5.0, 5.0], [6.0, 6.0, 6.0]) if far else TOP
    parts = {
        "scene": {"scene": {"up": up, "region": region}},
        "boundary": {"boundaries": [PinnedRegion(region)]},
        "material": {"material": Material(regions=[MaterialRegion(region, E=1.0)])},
        "edits": {"parts": {"edits": [Edit(region, E=1.0)]}},
    }[what]
    flag = dataclasses.replace(cloud, means=means, scales=cloud.scales.mean(-1, keepdim=True).expand(-1, 3))  # balls
    with value_error(r"Box\(min=") as caught:
        make_simulation(flag, pinned=False, **({"scene": {"up": up}} | parts)).start()
    said = str(caught.value)
    assert "between [0.05, -0.75, " in said  # in scene axes
    assert "(with z up, as for `wind.flow`: between [0.05, -0.0028, 0.05] and [1.15, 0.0028, 0.75])" in said
    held = f"it would hold {int(TOP.contains(cloud.means).sum())} of them"
    turn = f"with z up {held}, but regions are in scene axes, where up is [0.0, -1.0, 0.0]: turn the region."
    assert said.endswith(turn) is not far
    assert ("would hold" in said) is not far


@pytest.mark.parametrize(
    ("make", "field"),
    [
        *(
            (make, f"material.{name}")
            for name, value in (("E", 0.0), ("density", 0.0), ("thickness", -0.01), ("nu", 0.5), ("nu", -1.0))
            for make in (
                lambda name=name, value=value: Material(**{name: value}),
                lambda name=name, value=value: Material(regions=[MaterialRegion(LEFT, **{name: value})]),
            )
        ),
        (lambda: Material(volume="all"), "material.volume"),
        (lambda: Material(bending=0.0), "material.bending"),
        (lambda: Material(bending="thick"), "material.bending"),
        (lambda: Material(bending=1e-4, volume="cell"), "material.volume"),
        (lambda: Material(nu=torch.tensor(0.3, requires_grad=True), bending=1e-4), "material.nu"),
        (Scene, "scene.ply"),
        *(
            (lambda given=given: Scene(generator=FlagScene(spacing=0.1), **given), field)
            for given, field in (
                ({"faint": "hide"}, "scene.faint"),
                ({"area": "disc"}, "scene.area"),
                ({"opacity_threshold": 1.0}, "scene.opacity_threshold"),
                ({"up": [0.0, 1.0]}, "scene.up"),
                ({"up": [0.0, 0.0, 0.0]}, "scene.up"),
                ({"max_stretch": 1.0}, "scene.max_stretch"),
                ({"loose": "drop"}, "scene.loose"),
                ({"normals": "random"}, "scene.normals"),
                ({"layers": 2}, "scene.layers"),
                ({"layers": 3, "filling": InteriorFilling()}, "scene.filling"),
                ({"particle_spacing": 0.0}, "scene.particle_spacing"),
                ({"points": "few"}, "scene.points"),
                ({"points_per_cell": 0}, "scene.points_per_cell"),
                ({"wind_on": "inside"}, "scene.wind_on"),
                ({"wind_on": "all", "area": "open"}, "scene.wind_on"),
                ({"connected": "surface", "filling": InteriorFilling()}, "scene.connected"),
                ({"particle_spacing": 0.05, "filling": InteriorFilling()}, "scene.filling"),
            )
        ),
    ],
)
def test_settings_that_make_no_sense_are_named(make, field):
    with value_error(f"`{field}`"):
        make()


def _sheet_with_a_hole():
    """A square of 1 m in small Gaussians, but for the middle, which is one large Gaussian, the last."""
    cloud = FlagScene(width=1.0, height=1.0, spacing=0.05).generate()
    middle = ((cloud.means - torch.tensor([0.5, 0.0, 0.5])).abs() < 0.3).all(-1)
    edge, one = cloud.select(~middle), cloud.select(torch.tensor([0]))
    edge = dataclasses.replace(edge, scales=edge.scales - 0.5)  # they end near the rim of the sheet
    wide = one.scales + math.log(8) * (one.scales > one.scales.min())
    large = dataclasses.replace(one, means=torch.tensor([[0.5, 0.0, 0.5]]), scales=wide)
    return together(edge, large)


def test_large_gaussians_get_further_points(make_scene):
    cloud = _sheet_with_a_hole()
    count = len(cloud)
    lower = MaterialRegion(region=up_to(z=0.49), density=1000.0)
    material = Material(density=100.0, thickness=0.02, regions=[lower])
    plain = make_scene(cloud, material, 0.1)
    full = make_scene(cloud, material, 0.1, particle_spacing=0.05)
    assert plain.on_surface == plain.points.count == count
    assert full.on_surface == full.points.count > count + 50
    assert torch.equal(full.points.position[:count], plain.points.position)
    assert plain.patches.area.sum() < 0.9 < full.patches.area.sum() < 1.03
    density = full.points.mass / full.points.volume
    below = full.frame.point_to_scene(full.points.position.double())[:, 2] < 0.49
    torch.testing.assert_close(density, torch.where(below, 1000.0, 100.0))
    torch.testing.assert_close(full.points.volume, 0.02 * full.patches.area)
    of_large = full.patches.normal[count - 1 :]  # the flag is not quite flat, and one normal stands for the hole
    assert torch.equal(of_large, of_large[:1].expand_as(of_large))
    state = _rest_state(full)
    moved = full.deformed(state.replace(position=state.position + 0.25))
    torch.testing.assert_close(moved.means, cloud.means + 0.25)
    layered = make_scene(cloud, material, 0.1, particle_spacing=0.05, layers=3)
    assert layered.on_surface == full.points.count
    assert layered.points.count == 3 * full.points.count


def test_the_spacing_of_further_points_is_in_metres_and_they_share_the_papers_areas(make_scene):
    """Each Gaussian keeps pi s1 s2."""
    cloud = _sheet_with_a_hole()
    plain, full, half = (
        make_scene(cloud, dx=0.1, area="paper", particle_spacing=spacing, metres_per_unit=unit)
        for spacing, unit in ((None, 1.0), (0.05, 1.0), (0.1, 2.0))
    )
    assert half.points.count == full.points.count > plain.points.count
    torch.testing.assert_close(full.patches.area.sum(), plain.patches.area.sum())


def test_three_layers_are_no_thicker_than_a_cell(make_scene):
    cloud, thin, thick = _sheet_with_a_hole(), Material(thickness=0.1), Material(thickness=0.11)
    assert make_scene(cloud, thin, 0.1, layers=3).points.count
    assert make_scene(cloud, thick, 0.1, layers=1).points.count
    for material, told in (
        (thick, r"0\.11 m thick needs cells at least as large, but `solver\.dx` is 0\.1 m"),
        (Material(E=1e3, bending=0.1), r"outer layers 0\.\d+ m apart needs cells .* lower `material\.bending`"),
    ):
        with value_error(told):
            make_scene(cloud, material, 0.1, layers=3)


def test_three_layers_are_a_plate(make_cloud, make_scene):
    """The mass of one, and its moment about the middle plane: that of a plate of this thickness, h² / 12."""
    cloud = make_cloud()
    material = Material(thickness=0.03)
    one, three = (make_scene(cloud, material, layers=n) for n in (1, 3))
    count = one.points.count
    assert three.points.count == 3 * count
    torch.testing.assert_close(three.points.mass.sum(), one.points.mass.sum())
    height = ((three.points.position - one.points.position.repeat(3, 1)) * one.patches.normal.repeat(3, 1)).sum(-1)
    assert torch.equal(three.points.position[:count], one.points.position)
    moment = (three.points.mass * height.square()).sum() / three.points.mass.sum()
    assert float(moment) == pytest.approx(0.03**2 / 12, rel=1e-4)
    assert torch.equal(three.patches.areas()[:count], one.patches.area)  # the wind meets the sheet once
    assert not three.patches.areas()[count:].any()
    assert len(three.deformed(_rest_state(three)).means) == len(cloud)


def test_bending_says_where_the_layers_lie(make_cloud, make_scene):
    """D = E h d² / (12 (1 - nu²)) for a distance d of the outer layers: mass and E h stay, also in a region."""
    D = 2e5 * 0.01 * 0.004**2 / (12 * (1 - 0.3**2))
    lower = MaterialRegion(up_to(z=0.5), bending=4 * D)
    plate = Material(E=2e5, thickness=0.01)
    fabric = dataclasses.replace(plate, bending=D, regions=[lower])
    one, as_plate, bent = (make_scene(make_cloud(), m, layers=n) for m, n in ((plate, 1), (plate, 3), (fabric, 3)))
    torch.testing.assert_close(bent.points.mass, as_plate.points.mass)
    torch.testing.assert_close(bent.points.volume, as_plate.points.volume)
    count = one.points.count
    apart = (bent.points.position[count : 2 * count] - bent.points.position[2 * count :]).norm(dim=-1)
    below = bent.frame.point_to_scene(bent.points.position[:count].double())[:, 2] < 0.5
    assert 0 < int(below.sum()) < count
    torch.testing.assert_close(apart, torch.where(below, 0.008, 0.004), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("law", [FixedCorotated(), NeoHookean()])
def test_a_negative_ratio_whose_energy_has_no_least_value_is_warned_of(law, make_scene):
    nu, E = double(-0.3), double(1.0)
    lame = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    sizes = torch.logspace(-3, 1, 41, dtype=torch.float64)
    F = sizes[:, None, None] * EYE
    assert law.energy(F, *lame).min() < -0.01
    assert StVKHencky().energy(F, *lame).min() >= 0
    cloud = _sheet_with_a_hole()
    with user_warning(f"`material.nu` below 0 the energy of {type(law).__name__} has no least"):
        make_scene(cloud, Material(nu=-0.3, law=law), 0.1)
    with silent():
        make_scene(cloud, Material(nu=0.0, law=law), 0.1)
        make_scene(cloud, Material(nu=-0.3, law=StVKHencky()), 0.1)


def test_layers_share_the_volume_of_a_cell(make_scene):
    """By Simpson's rule: four parts in the middle, one at each face, half a thickness away."""
    material = Material(volume="cell", thickness=0.03)
    one, three = (make_scene(material=material, layers=layers, dx=0.25).points for layers in (1, 3))
    middle, upper, lower = three.volume.view(3, -1)
    torch.testing.assert_close(middle, one.volume * 4 / 6)
    torch.testing.assert_close(upper, lower)
    torch.testing.assert_close(middle + upper + lower, one.volume)
    apart = (three.position.view(3, -1, 3)[1] - one.position).norm(dim=-1)
    torch.testing.assert_close(apart, torch.full_like(apart, 0.015))


def test_normals_from_neighbours(make_cloud, make_scene):
    generator = seeded(2)
    cloud = FlagScene(width=0.6, height=0.4, spacing=0.02, ripple=0.0).generate()
    turn = torch.nn.functional.pad(0.15 * torch.randn(len(cloud.means), 3, generator=generator), (1, 0), value=1.0)
    cloud = dataclasses.replace(cloud, quats=rotation_to_quat(quat_to_rotation(turn) @ quat_to_rotation(cloud.quats)))
    material = Material(E=1e4, nu=0.3, density=100.0, thickness=0.01)
    found = {}
    for normals in ("smallest_axis", "neighbours"):
        scene = Scene(ply="unused", normals=normals, metres_per_unit=1.0)
        found[normals] = SimulatedScene(scene, material, dx=0.05, cloud=cloud)
    flat = found["neighbours"].rest_normals[:, 1].abs()
    assert flat.min() > 1 - 1e-6
    assert found["smallest_axis"].rest_normals[:, 1].abs().min() < 0.97
    assert found["neighbours"].rest_facing[:, 1].abs().min() > 1 - 1e-6
    assert found["neighbours"].patches.normal[:, 1].abs().min() > 1 - 1e-6


def test_a_trajectory_has_the_whole_deformation(make_scene):
    scene = make_scene(FlagScene(spacing=0.2).generate(), Material(law=Sand(35.0)))
    state = MPMSolver(0.4, "updated").init_state(scene.points)
    state = state.replace(F_total=1.5 * state.F_total)
    assert torch.equal(scene.surface(state)[1], state.F_total)
