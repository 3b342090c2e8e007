import math

import pytest
import torch
from shared import double, normalized, peak, randn, unit, value_error
from torch.testing import assert_close

from gaussian_swaying import AeroForce, aero_force
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.wind.force import LAWS, added_mass_per_area

RHO = 1.225


def _force(wind, normal, **options):
    arguments = {"drag": 0.0, "friction": 0.0, "lift": 0.0} | options
    normal = normalized(_vector(*normal))
    return aero_force(_vector(*wind), _vector(0, 0, 0)[None], normal[None], _vector(1.0), **arguments)[0]


def _random(count=200):
    draw = randn(count + 1, 3)
    return draw[0], draw[1:], unit(count, 3), torch.rand(count).double()


def _vector(*values):
    return double(values)


def test_resistance_is_half_the_slope_of_the_drag():
    """D = rho A C v_r / 2, so that f - D (v+ - v) is the drag c |v_r| (u - v+) of the new velocity."""
    area, wind, velocity = _vector(2.0), _vector(0, 0, 30.0), _vector(0, 0, -10.0)[None]
    aero = AeroForce(C_D=1.2, C_F=0.3, C_L=-0.1, air_density=RHO, drag_step="semi_implicit")
    expected = _vector(0.5 * RHO * 2.0 * (1.2 + 0.3 + 0.1) * 40.0)
    assert_close(aero.resistance(wind, velocity, area), expected)
    assert AeroForce().resistance(wind, velocity, area) is None


def test_each_term_against_the_equation():
    """Wind of 2 m/s along x on a patch at 45 degrees: q = rho / 2 * 4."""
    q, root = 0.5 * RHO * 4, 0.5**0.5
    normal = (root, 0.0, root)
    assert_close(_force((2.0, 0, 0), normal, drag=0.5), q * 0.5 * _vector(root, 0, root))
    # d - (d.n) n = (1/2, 0, -1/2)
    assert_close(_force((2.0, 0, 0), normal, friction=0.4), q * 0.4 * _vector(0.5, 0, -0.5))
    # d x n = (0, -root, 0)
    assert_close(_force((2.0, 0, 0), normal, lift=0.1), q * 0.1 * _vector(0, -root, 0))
    assert_close(_force((2.0, 0, 0), normal, drag=0.5, law="projected"), q * 0.5 * root * _vector(root, 0, root))


@pytest.mark.parametrize("law", ["paper", "projected", "cross_flow"])
def test_quadratic_linear_and_relative(law, device, dtype):
    wind, velocity, normal, area = (t.to(device, dtype) for t in _random())
    aero = AeroForce(law=law)
    base = aero(wind, velocity, normal, area)
    tol = {"rtol": 1e2 * torch.finfo(dtype).eps, "atol": 1e2 * torch.finfo(dtype).eps}
    assert_close(aero(3 * wind, 3 * velocity, normal, area), 9 * base, **tol)
    assert_close(aero(wind, velocity, normal, 2 * area), 2 * base, **tol)
    drift = torch.tensor([1.0, -2.0, 0.5], device=device, dtype=dtype)
    assert_close(aero(wind + drift, velocity + drift, normal, area), base, rtol=1e-4, atol=1e-5)
    assert base.dtype == dtype


def test_linear_law():
    """1/2 rho A C_D |u| (u - v).n n, and none in still air."""
    wind, velocity, normal, area = _random()
    options = {"drag": 0.7, "friction": 0.0, "lift": 0.0}
    force = aero_force(wind, velocity, normal, area, law="linear", **options)
    pressure = 0.5 * RHO * 0.7 * wind.norm() * ((wind - velocity) * normal).sum(-1)
    assert_close(force, (pressure * area)[:, None] * normal)
    assert not aero_force(torch.zeros(3).double(), velocity, normal, area, law="linear", **options).any()


def test_cross_flow_law():
    """1/2 rho A C_D |v_r.n| (v_r.n) n."""
    wind, velocity, normal, area = _random()
    options = {"drag": 0.7, "friction": 0.0, "lift": 0.0}
    force = aero_force(wind, velocity, normal, area, law="cross_flow", **options)
    through = ((wind - velocity) * normal).sum(-1)
    assert_close(force, (0.5 * RHO * 0.7 * through.abs() * through * area)[:, None] * normal)


@pytest.mark.parametrize("law", LAWS)
def test_still_air_exerts_nothing_and_has_a_gradient(law):
    """The gradient of |v| at zero must not be NaN."""
    velocity = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    force = AeroForce(law=law)(_vector(0, 0, 0), velocity, unit(4, 3), torch.ones(4).double())
    assert peak(force.detach()) == 0.0
    force.sum().backward()
    assert torch.isfinite(velocity.grad).all()


def test_edge_on_patch():
    """`paper` gives the full normal force at grazing flow, `projected` none."""
    assert float(_force((0.0, 2.0, 0), (0, 0, 1.0), drag=1.0).norm()) == pytest.approx(0.5 * RHO * 4)
    assert _force((0.0, 2.0, 0), (0, 0, 1.0), drag=1.0, law="projected").norm() == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_a_rotation_turns_the_force_and_the_sign_of_the_normal_does_not_matter(law):
    """A splat's normal has no outside: drag must never push upwind."""
    wind, velocity, normal, area = _random()
    aero = AeroForce(law=law)
    force = aero(wind, velocity, normal, area)
    assert_close(aero(wind, velocity, -normal, area), force)
    Q = quat_to_rotation(unit(4))
    assert_close(aero(Q @ wind, velocity @ Q.T, normal @ Q.T, area), force @ Q.T)
    drag = AeroForce(C_F=0.0, C_L=0.0, law=law)(wind, velocity, normal, area)
    assert ((drag * (wind - velocity)).sum(-1) >= 0).all()


@pytest.mark.parametrize("law", LAWS)
def test_gradcheck(law):
    wind, velocity, normal, area = _random(4)
    coefficients = _vector(0.5, 0.4, 0.1)

    def run(wind, velocity, normal, area, coefficients):
        drag, friction, lift = coefficients
        return aero_force(wind, velocity, normal, area, drag=drag, friction=friction, lift=lift, law=law)

    inputs = [t.requires_grad_() for t in (wind, velocity, normal, area, coefficients)]
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True)


@pytest.mark.parametrize(
    ("law", "speed", "part"), [("paper", 0.0, "C_D"), ("paper", 0.0, "C_F"), ("linear", 5.0, "C_D")]
)
def test_the_rate_is_the_slope_of_the_force(law, speed, part):
    coefficients = {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0, part: 0.7}
    aero = AeroForce(**coefficients, air_density=RHO, law=law, drag_step="semi_implicit")
    wind, area = _vector(3, 0, 0), _vector(0.2)
    velocity = _vector(speed, 0, 0)[None].requires_grad_()
    normal = _vector(1, 0, 0) if part == "C_D" else _vector(0, 1, 0)
    force = aero(wind, velocity, normal[None], area)[0, 0]
    (slope,) = torch.autograd.grad(force, velocity)
    assert (force < 0) == (speed > 3)
    assert float(aero.rate(wind.norm()[None], area, _vector(0.5))) == pytest.approx(-float(slope[0, 0]) / 0.5)
    if law == "linear":
        assert float(aero.resistance(wind, velocity.detach(), area)) == pytest.approx(-float(slope[0, 0]))


def test_bad_settings_are_refused():
    for name, values in {
        "law": ["plate"],
        "C_D": [-0.1],
        "air_density": [-1.0],
        "C_L": [math.nan],
        "added_mass": [-0.1, math.nan, math.inf],
        "max_area_ratio": [0.0, -1.0, math.nan],
        "drag_step": ["implicit"],
    }.items():
        for value in values:
            with value_error(f"{name}`"):
                AeroForce(**{name: value})


def test_a_plate_carries_the_air_of_a_cylinder_of_its_breadth():
    """Lamb: rho pi (b / 2)² for a length of the plate, which has an area of b."""
    for breadth in (0.05, 1.0, 3.0):
        assert added_mass_per_area(breadth, RHO) * breadth == pytest.approx(RHO * math.pi * (breadth / 2) ** 2)
    assert math.sqrt(0.2 / (0.2 + added_mass_per_area(1.0, 1.225))) == pytest.approx(0.415, abs=5e-4)
    assert AeroForce(added_mass=2.0, air_density=RHO).carried == added_mass_per_area(2.0, RHO)
    assert AeroForce().carried == AeroForce(added_mass=2.0, air_density=0.0).carried == 0.0


def test_shapes_are_checked():
    good = (torch.zeros(3), torch.zeros(5, 3), torch.ones(5, 3), torch.ones(5))
    for position, name, bad in (
        (0, "wind", torch.zeros(2)),
        (1, "velocity", torch.zeros(5, 2)),
        (2, "normal", torch.zeros(4, 3)),
        (3, "area", torch.ones(6)),
    ):
        arguments = list(good)
        arguments[position] = bad
        with value_error(f"Expected `{name}` of shape"):
            AeroForce()(*arguments)
