import pytest
import torch
from shared import double, near, up_to, value_error

from gaussian_swaying import AeroForce, Box, Edit, Material, MPMSolver, PinnedRegion, Simulation, SineSway, WindField
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.body import MaterialRegion
from gaussian_swaying.wind.field import FlowKey

VALUES = {"wind": 4.0, "E": 3e3, "nu": 0.3, "density": 30.0, "C_D": 0.5, "C_F": 0.4, "C_L": 0.1}
FRAMES = 2
ALL = Box([None, None, None], [None, None, None])
DOUBLE = torch.float64


def _simulation(values, edits=(), transfer="auto"):
    given = VALUES | values
    pin = PinnedRegion(up_to(x=0.11))
    return Simulation(
        FlagScene(spacing=0.1),
        solver=MPMSolver(0.2, substep=4e-3, gravity=(0.0, 0.0, -1.0), boundaries=[pin], transfer=transfer),
        wind=[1.0, given["wind"], 0.5],
        material=Material(**{name: given[name] for name in ("E", "nu", "density")}),
        aero=AeroForce(**{name: given[name] for name in ("C_D", "C_F", "C_L")}),
        edits=list(edits),
        dtype="float64",
        device="cpu",
    )


def _end(simulation):
    state = simulation.start()
    for _ in range(FRAMES):
        state, _ = simulation.advance(state)
    return state


def _moved(values):
    simulation = _simulation(values)
    moved = _end(simulation).position - simulation.scene.points.position
    return (moved * double([3.0, 1.0, 2.0])).sum(-1).mean()


def _leaf(value):
    return torch.tensor(value, dtype=DOUBLE, requires_grad=True)


@pytest.fixture(scope="module")
def slopes():
    leaves = {name: _leaf(value) for name, value in VALUES.items()}
    _moved(leaves).backward()
    return {name: float(leaf.grad) for name, leaf in leaves.items()}


@pytest.mark.parametrize("name", VALUES)
def test_a_gradient_is_that_of_central_differences(name, slopes):
    """D(h) = g + c h^2 + O(h^4): D(h/2) is off by a third of D(h) - D(h/2), and by rounding, some 1e-14 m / h."""
    value = VALUES[name]
    steps = (4e-4 * value, 2e-4 * value)
    wide, narrow = (float(_moved({name: value + h}) - _moved({name: value - h})) / (2 * h) for h in steps)
    bound = abs(wide - narrow) + 1e-14 / steps[1]
    assert bound < 1e-5 * abs(narrow)
    assert abs(slopes[name] - narrow) < bound


def test_tensors_change_no_bit():
    """In torch; kernels without gradients round otherwise."""
    leaves = {name: _leaf(value) for name, value in VALUES.items()}
    plain = _end(_simulation({}, transfer="torch"))
    with_gradients = _end(_simulation(leaves, transfer="torch"))
    assert with_gradients.position.requires_grad
    assert torch.equal(plain.position, with_gradients.position)
    assert torch.equal(plain.velocity, with_gradients.velocity)
    plain, with_gradients = _end(_simulation({})), _end(_simulation(leaves))
    torch.testing.assert_close(plain.position, with_gradients.position.detach(), rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(plain.velocity, with_gradients.velocity.detach(), rtol=1e-13, atol=1e-13)


def test_a_rollout_in_parts_has_the_same_gradient():
    found = []
    for checkpoint in (None, 3):
        leaves = {name: _leaf(value) for name, value in VALUES.items()}
        simulation = _simulation(leaves)
        options = {} if checkpoint is None else {"checkpoint": checkpoint}
        end = simulation.solver.rollout(simulation.start(), 4e-3, 10, simulation.forces, **options)
        end.position.square().sum().backward()
        found.append(torch.stack([leaf.grad for leaf in leaves.values()]))
    assert (found[0] != 0).all()
    torch.testing.assert_close(*found, rtol=1e-10, atol=0.0)


def test_a_flow_keeps_its_gradient():
    flow = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)  # float32 as well
    WindField(flow)(0.5).square().sum().backward()
    torch.testing.assert_close(flow.grad, 2 * flow.detach())
    speed = _leaf(4.0)
    WindField([0.0, speed, 0.0])(0.5).sum().backward()
    assert float(speed.grad) == 1.0
    later = _leaf([0.0, 6.0, 0.0])
    wind = WindField(schedule=[FlowKey(0.0, [0.0, 2.0, 0.0]), FlowKey(1.0, later)], interpolation="linear")
    wind(0.25).sum().backward()
    torch.testing.assert_close(later.grad, torch.full((3,), 0.25, dtype=DOUBLE))
    keys = _leaf([4.0, 90.0, 2.0])
    sway = [SineSway(0.5, 1.0)]
    wind = WindField(schedule=[FlowKey(0.0, None, *keys)], modulations=sway)
    wind(0.25)[1].backward()  # speed (1 + gusts / 2)
    torch.testing.assert_close(keys.grad, double([2.0, 0.0, 2.0]))


def test_a_coefficient_that_is_zero_has_a_slope():
    slope = _leaf(0.0)
    _moved({"C_D": slope, "C_F": 0.0, "C_L": 0.0}).backward()
    assert float(slope.grad) > 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Material(thickness=_leaf(0.01)), "`material.thickness` without a gradient"),
        (lambda: Material(E=_leaf(-1.0)), r"`material.E` to be positive and finite, but got -1\.0"),
        (lambda: Material(nu=_leaf(0.7)), "`material.nu`"),
        (lambda: Material(regions=[MaterialRegion(ALL, E=_leaf(1e4))]), "`material.E` without a gradient"),
        (lambda: Material(regions=[MaterialRegion(ALL, nu=_leaf(0.2))]), "`material.nu` without a gradient"),
        (
            lambda: Material(E=_leaf(1e4), regions=[MaterialRegion(ALL, E=1e5)]),
            "`material.E` requires a gradient, but `material.regions` gives it too",
        ),
        (lambda: AeroForce(air_density=_leaf(1.2)), "`air_density` without a gradient"),
        (lambda: AeroForce(max_area_ratio=_leaf(1.2)), "`max_area_ratio` without a gradient"),
        (lambda: AeroForce(C_D=_leaf(-0.5)), "`C_D` to not be negative"),
        (lambda: WindField(_leaf([1.0, float("nan"), 0.0])), "`flow` to be finite"),
        (lambda: WindField(_leaf([1.0, 0.0])), "`flow` to have 3 numbers"),
        (lambda: SineSway(amplitude=_leaf(0.5)), "`amplitude` without a gradient"),
        (lambda: SineSway(phase=_leaf(0.5)), "`phase` without a gradient"),
        (lambda: MPMSolver(0.1, gravity=_leaf([0.0, 0.0, -9.8])), "`gravity` without a gradient"),
        (lambda: MPMSolver(0.1, damping=_leaf(1.0)), "`damping` without a gradient"),
        (lambda: MPMSolver(0.1, stiffness_damping=_leaf(1e-3)), "`stiffness_damping` without a gradient"),
        (lambda: Edit(E=_leaf(1e4)), "`edits.E` without a gradient"),
        (lambda: _simulation({"E": _leaf(1e4)}, [Edit(density=10.0)]), "would lose the gradient of `material`"),
    ],
)
def test_a_gradient_that_would_be_lost_is_refused(make, words):
    with value_error(words):
        make()


def test_a_colour_can_be_edited_beside_a_gradient():
    simulation = _simulation({"E": _leaf(3e3)}, [Edit(color=[1.0, 0.0, 0.0])])
    assert _end(simulation).position.requires_grad


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat"])
def test_a_frame_with_a_gradient_is_saved(suffix, tmp_path):
    for name, values in (("with", {"E": _leaf(3e3)}), ("without", {})):
        *_, frame = _simulation(values).frames(2)
        frame.save(tmp_path / f"{name}{suffix}")
    found, wanted = (read_gaussians(tmp_path / f"{name}{suffix}") for name in ("with", "without"))
    near(found.means, wanted.means, 1e-4)  # kernels draw the frame without a gradient
    near(found.scales, wanted.scales, 1e-2)
