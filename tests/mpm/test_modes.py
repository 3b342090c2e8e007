import math

import pytest
import torch
from shared import ZERO, double, longest, near, randn, seeded, solid, up_to, value_error
from small_scenes import plain_cloud
from torch.testing import assert_close

from gaussian_swaying import (
    AeroForce,
    Force,
    Material,
    MPMSolver,
    PinnedRegion,
    WindField,
    WindForce,
)
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.mpm import modal
from gaussian_swaying.mpm.damping import decay_rate
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.modes import LONGEST, SHORTEST, warped

FOOT = up_to(z=0.1)
POINTS = 320


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setattr(modal, "cache_folder", lambda: folder)
        yield


def post(E=1e6, density=100.0, ratio=0.0, law=None, **more):
    """A square post of 1 m, four points and two cells wide."""
    axes = [(torch.arange(n).double() + 0.5) * 0.05 for n in (4, 4, 20)]
    damping = decay_rate(ratio, 1.0) if ratio else None
    return solid(torch.cartesian_prod(*axes), 0.05**3, density, E, law=law, damping=damping, **more)


def solver_of(formulation="modes", pins=None, **more):
    pins = [PinnedRegion(FOOT, kind="nodes")] if pins is None else pins
    return MPMSolver(0.1, formulation, **{"gravity": (0, 0, 0), "boundaries": pins, "transfer": "torch"} | more)


def wind(speed=8.0, drag=1.0, points=POINTS):
    """On one patch along x for each point, 0.2 m² in all."""
    normal = torch.zeros(points, 3).double()
    normal[:, 0] = 1.0
    area = torch.full((points,), 0.2 / points, dtype=torch.float64)
    aero = AeroForce(law="projected", C_D=drag, C_F=0.0, C_L=0.0, drag_step="semi_implicit")
    return WindForce(aero, WindField(torch.as_tensor([1.0, 0.0, 0.0], dtype=torch.float64) * speed), normal, area)


def run(solver, state, force=None, frames=1, seconds=0.04):
    for _ in range(frames):
        steps = solver.substeps(state, seconds)
        state = solver.rollout(state, seconds / steps, steps, force)
    return state


def pulled(solver, points, size, frames=0):
    velocity = torch.zeros_like(points.position)
    velocity[:, 0] = size * points.position[:, 2] ** 2
    return run(solver, solver.init_state(points, velocity), frames=frames)


def energy(solver, state):
    found = solver.energies(state)
    return found["kinetic"] + found["elastic"]


# ---- against total


@pytest.mark.parametrize(("speed", "lean", "error"), [(7.5, 0.08, 0.03), (15.0, 0.3, 0.10)])
def test_it_leans_as_total_does(speed, lean, error):
    """The mean state in a steady wind: modes are linear and warped, so the error grows with the square of the lean."""
    points, moved = post(E=7e4, ratio=0.5), []
    for formulation in ("modes", "total"):
        solver = solver_of(formulation)
        state = run(solver, solver.init_state(points), wind(speed, 1.2), frames=60)  # what swings is below e^-10
        moved.append(state.position - points.position)
    top = points.position[:, 2] > 0.95
    assert float(moved[1][top].mean(0).norm()) == pytest.approx(lean, rel=0.2)
    apart = (moved[0] - moved[1]).norm(dim=-1)
    assert apart.max() < error * longest(moved[1])


# ---- energy and damping


def test_the_work_of_a_force_is_the_gain_of_energy():
    class Push(Force):
        def forward(self, state):
            return state.position.new_tensor([0.02, 0.01, 0.0]).expand_as(state.position)

        def on_sites(self, site, count):
            weight = torch.zeros(count).double().index_add_(0, site, torch.ones_like(site).double())

            class Summed(Force):
                def forward(self, state):
                    return weight[:, None] * state.position.new_tensor([0.02, 0.01, 0.0])

            return Summed()

    for force in (Push(), Push().forward):  # as groups, and as a function that sees all points
        points, solver = post(E=1e5), solver_of()
        state = solver.init_state(points)
        state = run(solver, state, force, frames=25)
        gain = energy(solver, state)
        assert float(gain) > 1e-4
        # the load is that of the middle of a substep, and is constant in it: no error
        assert float(state.work) == pytest.approx(float(gain), rel=1e-10)


def free_decay(solver, points):
    """Damping ratio of the mode of the lean by its energy, as its amplitude is known at any time."""
    state = pulled(solver, points, 0.1)
    bound = solver.bound
    own = int((bound.square.sqrt() - bound.first).abs().argmin())
    q, p = (torch.zeros_like(x) for x in bound.amplitudes(state))
    q[own] = 1e-3
    state = bound.shown(state, q, p)
    seconds = 0.04 * 50
    state = run(solver, state, frames=50)
    q, p = bound.amplitudes(state)
    omega = float(bound.square[own].sqrt())
    return own, omega, seconds, float(q[own]), float(p[own])


@pytest.mark.parametrize(
    ("ratio", "rate", "stiff"),
    [(0.0, 0.0, 0.0), (0.03, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 2e-3), (0.03, 0.4, 2e-3)],
)
def test_a_free_decay_has_the_ratio_of_the_material_and_of_the_solver(ratio, rate, stiff):
    """The closed form q = e^(-zeta w t) (cos(w_d t) + zeta w / w_d sin(w_d t)), to rounding."""
    solver = solver_of(damping=rate, stiffness_damping=stiff)
    own, omega, seconds, q, p = free_decay(solver, post(ratio=ratio))
    zeta = ratio + rate / (2 * omega) + stiff * omega / 2
    assert float(solver.bound.ratio[own]) == pytest.approx(zeta, rel=1e-6)  # the mass of float64 shares
    damped = omega * math.sqrt(1 - zeta**2)
    decay = math.exp(-zeta * omega * seconds)
    exact = 1e-3 * decay * (math.cos(damped * seconds) + zeta * omega / damped * math.sin(damped * seconds))
    assert q == pytest.approx(exact, abs=1e-3 * 1e-6)
    assert p == pytest.approx(-1e-3 * decay * omega**2 / damped * math.sin(damped * seconds), abs=1e-3 * omega * 1e-6)


@pytest.mark.parametrize("weight", [(0.0, 0.0, 0.0), (0.0, 0.0, -9.8)])
def test_the_support_takes_the_load_in_balance(weight):
    """The impulse of the pin in a second of rest is the load, but for what acts next to the pin.

    It would be carried by modes that are stiffer than those that are kept: those of two cells of ten above the pin,
    with a half of the load of the first.
    """
    load = double([2.0, 0.5, 0.0])
    points, solver = post(E=1e7, ratio=0.9), solver_of(gravity=weight)

    def force(state):
        return (load / POINTS).expand_as(state.position)

    state = run(solver, solver.init_state(points), force, frames=50)
    later = run(solver, state, force, frames=25)
    taken = (later.impulse - state.impulse).reshape(-1, 3).sum(0)
    load = load + points.mass.sum() * double(weight)
    assert (taken - load).norm() < 0.12 * load.norm()


# ---- warping


def test_a_rigid_turn_is_exact():
    """d = w x r, integrated along the turn, is R(w) r - r."""
    w = double([[0.3, -0.2, 0.9], [0.0, 0.0, 1e-4], [2.0, 0.0, 0.0]])
    r = randn(3, 3, generator=seeded(0))
    found = warped(w, torch.linalg.cross(w, r))
    exact = (rotation_of(w) @ r[..., None])[..., 0] - r
    assert_close(found, exact, rtol=1e-9, atol=1e-13)
    near(warped(0 * w, r), r, 0)


# ---- batches and gradients


@pytest.mark.parametrize("name", ["flow", "E", "C_D", "density"])
def test_gradients_are_those_of_differences(name):
    """Of the place of the top after half a second; the shapes of the modes do not change with a factor of E or mass."""

    def top(value):
        numbers = {"flow": 6.0, "E": 1e5, "C_D": 1.0, "density": 100.0} | {name: value}
        points = post(E=numbers["E"], density=numbers["density"])
        force = wind(numbers["flow"], numbers["C_D"])
        solver = solver_of()
        state = solver.rollout(solver.init_state(points), 0.01, 50, force)
        return state.position[points.position[:, 2] > 0.95, 0].mean()

    first = {"flow": 6.0, "E": 1e5, "C_D": 1.0, "density": 100.0}[name]
    value = double(first).requires_grad_()
    (slope,) = torch.autograd.grad(top(value), value)
    step = 1e-4 * first
    with torch.no_grad():
        after, before = (top(double(first + sign * step)) for sign in (1, -1))
    expected = (after - before) / (2 * step)  # its error is some (step / first)² = 1e-8
    assert abs(float(expected)) > 0
    assert float(slope) == pytest.approx(float(expected), rel=1e-6)


# ---- in a simulation


def swaying(make_simulation, formulation="modes", **more):
    """A slab of 0.2 m, four points thick."""
    axes = [(torch.arange(n) + 0.5) * 0.05 for n in (16, 4, 12)]
    cloud = plain_cloud(torch.cartesian_prod(*axes), -3.5, logit=3.0)
    scene = {"metres_per_unit": 1.0, "opacity_threshold": 0.0}
    return make_simulation(cloud, scene=scene, formulation=formulation, gravity=ZERO, dx=0.1, **more)


def test_a_change_keeps_the_motion_continuous(make_simulation):
    simulation = swaying(make_simulation)
    state = simulation.start()
    for _ in range(10):
        state, _ = simulation.advance(state)
    for values in ({"material.E": 9e3}, {"solver.damping": 3.0}, {"material.density": 60.0}, {"wind.speed": 1.0}):
        before = state
        simulation.change(values)
        q, p = simulation.solver.bound.amplitudes(state)
        shown = simulation.solver.bound.shown(state, q, p)
        assert_close(shown.position, before.position, rtol=1e-5, atol=1e-6)
        assert_close(shown.velocity, before.velocity, rtol=1e-4, atol=1e-5)
        state, _ = simulation.advance(state)
        moved = longest(state.position - before.position)
        assert float(moved) < 0.04 * 3 * float(longest(before.velocity)) + 0.01


def test_another_pin_keeps_what_of_the_motion_its_modes_can_show():
    points, solver = post(E=1e5), solver_of()
    state = run(solver, pulled(solver, points, 0.5), frames=5)
    wider = solver_of(pins=[PinnedRegion(up_to(z=0.25))])
    start = wider.init_state(points)
    after = wider.continued(solver, state, start)
    top = points.position[:, 2] > 0.95
    moved, kept = (s.position[top] - points.position[top] for s in (state, after))
    assert moved[:, 0].mean() > 0.005
    assert (kept - moved).norm(dim=-1).mean() < 0.3 * moved.norm(dim=-1).mean()
    assert float(after.time) == float(state.time)


# ---- limits


def test_a_frame_has_from_four_to_sixteen_substeps():
    for stiffness, expected in ((1e2, 4), (1e4, 4), (2e6, None), (1e9, 16)):
        solver = solver_of()
        state = solver.init_state(post(E=stiffness))
        steps = solver.substeps(state, 0.04)
        wanted = 2 * math.pi / solver.bound.first / 20
        assert steps == math.ceil(0.04 / min(max(wanted, SHORTEST), LONGEST) - 1e-9)
        assert expected is None or steps == expected
        assert 4 <= steps <= 16
        assert solver.bound.stable_substep(state) == math.inf


def test_a_force_may_resist():
    points, solver = post(E=1e5), solver_of()

    def brake(now):
        return -0.5 * now.velocity, torch.full_like(now.position[..., 0], 0.5)

    moving = pulled(solver, points, 1.0)
    first = energy(solver, moving)
    after = solver.rollout(moving, 0.01, 100, brake)
    assert float(energy(solver, after)) < 0.01 * float(first)
    assert float(after.work) == pytest.approx(float(energy(solver, after) - first), rel=0.02)


@pytest.mark.parametrize(
    ("points", "pins", "words"),
    [
        ({}, [], "nothing holds it: pin a part of it, or set it to total"),
        ({"law": Sand()}, None, "the law Sand flows: set it to updated"),
        (
            {"normal": torch.tensor([0.0, 1.0, 0.0]).double().expand(POINTS, 3), "bending": 1e-6},
            None,
            "`material.bending` makes it a sheet, which folds: set it to total",
        ),
        ({}, [PinnedRegion(FOOT, end=2.0)], "does not hold it all the time: set it to total"),
    ],
)
def test_what_modes_cannot_do_is_refused(points, pins, words):
    with value_error(r"`solver.formulation: modes` is for a held body") as error:
        solver_of(pins=pins).init_state(post(**points))
    assert words in str(error.value)
    with value_error("`pivot`"):
        solver_of("total", pivot=True)


def test_on_a_pivot_it_sways_as_easily_along_as_across():
    axes = [(torch.arange(n).double() + 0.5) * 0.05 for n in (2, 10, 20)]
    plank = solid(torch.cartesian_prod(*axes), 0.05**3, 100.0, 1e6)
    pins = [PinnedRegion(up_to(z=0.1), kind="nodes")]
    free, pivot = (solver_of(pins=pins, pivot=on) for on in (False, True))
    free.init_state(plank)
    velocity = torch.zeros_like(plank.position)
    velocity[:, :2] = 0.01 * plank.position[:, 2:] ** 2
    state = pivot.init_state(plank, velocity)
    second = int(pivot.bound.square.isclose(pivot.bound.square.new_tensor(pivot.bound.first**2)).nonzero()[1])
    assert float(free.bound.square[second]) > 4 * free.bound.first**2
    assert pivot.bound.first == free.bound.first
    top, along = plank.position[:, 2] > 0.9, []
    for _ in range(40):
        state = run(pivot, state)
        along.append((state.position - plank.position)[top].mean(0))
    x, y, _ = torch.stack(along).T
    assert torch.corrcoef(torch.stack([x, y]))[0, 1] > 0.95  # on one line, which two frequencies would leave


def test_auto_takes_modes_where_they_will_do_and_says_why(make_simulation):
    held = solver_of("auto")
    held.init_state(post())
    assert (held.formulation, held.why) == ("modes", "it is held, and nothing touches or folds")
    free = solver_of("auto", pins=[])
    free.init_state(post())
    assert (free.formulation, free.why) == ("total", "nothing holds it")
    flows = solver_of("auto")
    flows.init_state(post(law=Sand()))
    assert flows.formulation == "updated"
    assert "Sand" in flows.why
    for E, formulation in ((1e7, "modes"), (300.0, "total")):
        simulation = swaying(make_simulation, "auto", material=Material(E=E, density=30.0))
        told = simulation.solver.describe(simulation.start())
        assert told["formulation"] == formulation
        assert told["why"] == simulation.solver.why
        assert ("more than modes" in told["why"]) == (formulation == "total")
        state, _ = simulation.advance(simulation.start())
        simulation.change("material.E", 300.0)  # while it runs, it stays what it is
        assert simulation.solver.formulation == formulation
        state, _ = simulation.advance(state)
        assert state.position.isfinite().all()
        simulation.start()
        assert simulation.solver.formulation == "total"
