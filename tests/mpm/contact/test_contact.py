from dataclasses import replace

import pytest
import torch
from contacts import crossings, gaps, sheet_triangles
from shared import ZERO, longest, near, peak, value_error

from gaussian_swaying import Contact, MaterialPoints, MPMSolver, PinnedPoints
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.contact import Surface

from .bodies import layers, march, scene, sheet

THICKNESS = 0.01
GROUND = [0.0, 0.0, -0.005], [0.0, 0.0, 1.0]


def _two(speed, angle=0.0, dtype=torch.float64):
    below, above = sheet(16, 16, dtype=dtype), sheet(10, 10, (0.053, 0.047, 0.13), dtype=dtype)
    points = MaterialPoints.join([below, above])
    velocity = torch.zeros_like(points.position)
    velocity[below.count :] = speed * torch.tensor([angle, 0.0, -1.0], dtype=dtype)
    return points, velocity, torch.cat([sheet_triangles(16, 16), sheet_triangles(10, 10, below.count)])


@pytest.mark.slow(gate=["0.0-50.0", "0.5-2.0"])
@pytest.mark.parametrize("speed", [2.0, 50.0])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_sheets_that_collide_do_not_pass_each_other(speed, friction):
    """At 50 m/s a substep would carry them five thicknesses. Momentum stays to round-off, energy does not grow."""
    points, velocity, triangles = _two(speed, 0.3)
    solver, state = scene(points, Contact(friction=friction), velocity=velocity, gravity=ZERO)
    before, momentum = solver.energies(state), solver.momenta(state)["linear"]
    shares = []
    for later in march(solver, state, 0.6 / speed, frame=0.02 / speed):
        assert crossings(later.position, triangles) == 0
        shares.append(gaps(solver.bound.contact, later))
        energy = solver.energies(later)
        assert float(energy["kinetic"] + energy["elastic"]) < (1 + 1e-3) * float(before["kinetic"])
    found = torch.cat(shares)
    assert len(found) > 500  # they touched
    assert (found < 0.5).double().mean() <= 1e-3
    after = solver.momenta(later)["linear"]
    near(after, momentum, 1e-14 * speed)
    if friction == 0:  # without friction nothing but the tilt of the sheets pulls sideways
        assert later.velocity[points.count - 100 :, 0].mean() > 0.7 * 0.3 * speed


@pytest.mark.parametrize("seconds", [0.46, pytest.param(0.8, marks=pytest.mark.slow)])
def test_a_strip_that_falls_folds_and_does_not_cross_itself(seconds):
    """Upright on the ground, with a slight bend, it buckles into layers of one sheet."""
    points = sheet(40, 8, axes=(2, 1), E=5e3)
    solver, state = scene(
        points,
        Contact(),
        [Obstacle(HalfSpace(*GROUND))],
        velocity=torch.stack([torch.sin(9 * points.position[:, 2]), 0 * points.mass, 0 * points.mass], -1) * 0.3,
        normal=(1.0, 0.0, 0.0),
        stiffness_damping=1e-3,
    )
    triangles, found = sheet_triangles(40, 8), []
    for later in march(solver, state, seconds, frame=0.02):
        found.append(gaps(solver.bound.contact, later))
        assert crossings(later.position, triangles) == 0
    found = torch.cat(found)
    assert len(found) > 1000 * (seconds - 0.3)
    assert (found < 0.5).double().mean() <= 1e-3


@pytest.mark.parametrize("count", [8, *(pytest.param(n, marks=pytest.mark.slow) for n in (15, 50))])
def test_layers_pressed_together_stay_in_order(count):
    """They fall on each other with twice the weight; every layer stays above the one below it, everywhere."""
    ground = [Obstacle(HalfSpace(*GROUND))]
    solver, state = layers(count, 1.1 * THICKNESS, shift=0.003, boundaries=ground, gravity=(0, 0, -20.0))
    for later in march(solver, state, 0.15, frame=0.03):
        height = later.position[:, 2].reshape(count, -1)
        assert (height[1:] - height[:-1]).min() > 0.3 * THICKNESS
        assert (gaps(solver.bound.contact, later) < 0.5).double().mean() <= 1e-3


def _rest(count, seconds, dtype=torch.float64):
    settings = {"gravity": (0, 0, -9.8), "stiffness_damping": 1e-3, "boundaries": [Obstacle(HalfSpace(*GROUND))]}
    solver, state = layers(count, THICKNESS, side=5, shift=0.003, dtype=dtype, **settings)
    settled = march(solver, state, 0.5, frame=0.1)[-1]
    later = march(solver, settled, seconds, frame=0.1)
    first = solver.energies(settled)
    weight = float(solver.points.mass.sum() * 9.8)
    for end in later:
        energy = solver.energies(end)
        assert float(energy["kinetic"]) < 1e-4 * weight * THICKNESS
    bent = float(energy["elastic"] - first["elastic"])
    change = float(energy["potential"] - first["potential"]) + bent
    height = settled.position[:, 2].reshape(count, -1).mean(1), end.position[:, 2].reshape(count, -1).mean(1)
    scale = weight * THICKNESS
    return change / scale, bent / scale, float(peak(height[1] - height[0]))


@pytest.mark.parametrize(("count", "seconds"), [(2, 0.3), pytest.param(5, 0.5, marks=pytest.mark.slow)])
def test_a_pile_at_rest_stays_at_rest(count, seconds):
    """No layer moves by more than 1 % of the thickness, energy does not grow, and no bending builds up."""
    change, bent, moved = _rest(count, seconds)
    assert change < 1e-3
    assert bent < 5e-6  # 30e-6 if friction does not yield, and it then grows
    assert moved < 0.01 * THICKNESS


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(("dtype", "seconds"), [(torch.float64, 11.5), (torch.float32, 60.0)])
def test_a_pile_rests_for_long(dtype, seconds):
    """It slides slowly, and so sinks a little; energy does not grow."""
    change, bent, moved = _rest(8, seconds, dtype)
    assert change < 1e-3
    assert bent < 1e-4
    assert moved < 0.02 * THICKNESS


def test_the_lists_do_not_change_the_result(monkeypatch):
    points, velocity, _ = _two(2.0, 0.3)
    solver, state = scene(points, Contact(), velocity=velocity, gravity=ZERO)
    still = state.replace(velocity=0 * velocity, node_velocity=0 * state.node_velocity)
    solver.rollout(still, 1e-4, 8)
    assert solver.kernels.touching.interval == 64
    known = solver.rollout(state, 5e-4, 160)
    assert 1 < solver.kernels.touching.interval < 64
    monkeypatch.setattr("gaussian_swaying.mpm.contact.LONGEST", 1)
    other, state = scene(points, Contact(), velocity=velocity, gravity=ZERO)
    other.rollout(still, 1e-4, 1)
    again = other.rollout(state, 5e-4, 160)
    assert other.kernels.touching.interval == 1
    near(again.position, known.position, 1e-10)
    assert peak(known.velocity - velocity) > 1.0  # they touched


@pytest.mark.parametrize("transfer", ["auto", "torch"])
def test_contact_without_kernels_is_refused(transfer):
    solver, state = scene(_two(2.0)[0], Contact(), transfer=transfer)
    with value_error(r"no gradients through contact: leave `solver.transfer` on auto"):
        solver.rollout(state.replace(node_velocity=state.node_velocity.requires_grad_()), 1e-4, 1)


def test_bad_settings_are_refused():
    for name, value in (("thickness", 0.0), ("friction", -0.1)):
        with value_error(f"`contact.{name}`"):
            Contact(**{name: value})


def test_contact_needs_normals_and_fixed_neighbours():
    points = sheet(4, 4)
    with value_error("`normal` and `spacing`"):
        Surface.of_points(points, contact=Contact())
    surface = Surface.of_points(points, torch.ones(16, 3), 0.02, 0.01, Contact())
    with value_error("leave out `contact`"):
        MPMSolver(0.05, "updated").init_state(points, surface=surface)
    astray = replace(surface, read=surface.read + 9.0)
    with value_error("outside the material"):
        MPMSolver(0.05).init_state(points, surface=astray)


def test_pins_are_stronger_than_contact():
    points, velocity, _ = _two(2.0)
    corners = [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.3, 0.3, 0.0]]
    solver, state = scene(points, Contact(), [PinnedPoints(corners)], velocity=velocity)
    end = march(solver, state, 0.12)[-1]
    held = torch.tensor([0, 15, 15 * 16, 255])
    near(end.position[held], points.position[held], 1e-9)
    assert end.position[256:, 2].mean() > end.position[:256, 2].min()


# ---- hard cases of contact end finite, or are refused with a sentence


def _finite(state):
    return bool(torch.isfinite(state.position).all() & torch.isfinite(state.velocity).all())


def test_sheets_in_the_same_place_come_apart():
    """Three sheets exactly in one place: the impulses are finite, momentum stays, and no speed is above the bound."""
    solver, state = layers(3, 0.0)
    for later in march(solver, state, 0.02, frame=0.005):
        assert _finite(later)
        assert longest(later.velocity) < 5.0
    near(solver.momenta(later)["linear"], torch.zeros(3).double(), 1e-12)


def test_everything_in_contact_at_half_the_thickness():
    solver, state = layers(5, 0.5 * THICKNESS, stiffness_damping=1e-3)
    later = march(solver, state, 0.1, frame=0.02)[-1]
    height = later.position[:, 2].reshape(5, -1)
    assert _finite(later)
    assert (height[1:] - height[:-1]).min() > 0.9 * THICKNESS
    assert longest(later.velocity) < 2.0


def test_a_thickness_above_the_spacing_is_kept():
    below, above = sheet(14, 14), sheet(8, 8, (0.053, 0.047, 0.2))
    points = MaterialPoints.join([below, above])
    velocity = torch.zeros_like(points.position)
    velocity[below.count :, 2] = -2.0
    solver, state = scene(points, Contact(thickness=0.06, friction=0.0), velocity=velocity, gravity=ZERO)
    still = march(solver, state, 0.04, frame=0.02)[-1]
    near(still.position[: below.count], below.position, 1e-12)
    triangles = torch.cat([sheet_triangles(14, 14), sheet_triangles(8, 8, below.count)])
    least = 1.0
    for later in march(solver, still, 0.12, frame=0.02):
        assert _finite(later)
        assert crossings(later.position, triangles) == 0
        apart = later.position[below.count :, None] - later.position[None, : below.count]
        least = min(least, float(apart.norm(dim=-1).min()))
    assert 0.5 * 0.06 < least < 0.08


@pytest.mark.parametrize("broken", ["normal", "radius", "both"])
def test_patches_without_a_normal_or_a_size_end_finite(broken):
    def change(surface):
        every = torch.arange(len(surface.place)) % 3 == 0
        facing = torch.where(every[:, None], 0.0, surface.normal) if broken != "radius" else surface.normal
        radius = torch.where(every, 0.0, surface.radius) if broken != "normal" else surface.radius
        return replace(surface, normal=facing, radius=radius)

    solver, state = layers(3, 0.8 * THICKNESS, change=change, stiffness_damping=1e-3)
    later = march(solver, state, 0.03, frame=0.01)[-1]
    height = later.position[:, 2].reshape(3, -1)
    assert _finite(later)
    assert (height[1:] - height[:-1]).mean() > 0.85 * THICKNESS
