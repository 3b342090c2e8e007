from importlib import import_module
from pkgutil import iter_modules

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import ZERO, beyond, double, in_both, near, peak, seeded, solid, up_to, value_error

from gaussian_swaying import MaterialPoints, MPMSolver, PinnedRegion
from gaussian_swaying.geometry import linalg
from gaussian_swaying.mpm import dispatch, laws

FORMULATIONS = ["total", "updated"]


def _points(size, spacing, law=None, e=1e4, density=100.0, thickness=None):
    axes = [(torch.arange(max(round(side / spacing), 1)).double() + 0.5) * spacing for side in size]
    position = torch.cartesian_prod(*axes)
    volume = spacing**3 if thickness is None else spacing**2 * thickness
    return solid(position, volume, density, e, law=law)


def _bar():
    return _points((0.05, 0.05, 0.7), 0.025, e=3e4), beyond(z=0.6), (0, 0, -9.8)


def _cantilever():
    return _points((0.6, 0.05, 0.1), 0.025, e=1e5), up_to(x=0.1), (0, 0, -9.8)


def _sheet():
    points = _points((0.6, 0, 0.4), 0.025, e=1e4, density=30.0, thickness=0.01)
    return points, up_to(x=0.1), (0, 0.3, 0)


def _move(points, region, gravity, formulation, dx, seconds):
    solver = MPMSolver(dx, formulation, gravity=gravity, cfl=0.3, boundaries=[PinnedRegion(region)])
    state = solver.init_state(points)
    for _ in range(round(seconds / 0.02)):
        steps = solver.substeps(state, 0.02)
        state = solver.rollout(solver.fit_grid(state, 0.02), 0.02 / steps, steps)
    return state.position - points.position


@pytest.mark.slow(gate=["_bar-dxs0", "_sheet-dxs2"])
@pytest.mark.parametrize(("make", "dxs"), [(_bar, (0.1, 0.05)), (_cantilever, (0.1, 0.05)), (_sheet, (0.1, 0.05))])
def test_formulations_agree_within_their_discretisation_error(make, dxs):
    """As long as neither tears. Each error is estimated by the grid convergence index of two grids at order one (that
    of a pin), which is three times the change from dx to dx / 2 (Roache 1994).

    The border of each pin lies on a plane of nodes of both grids: the error depends on where it lies in its cell.
    """
    points, region, gravity = make()

    def size(move):  # root mean square: the layer of cells next to the pin differs on any grid, however fine
        return float(move.square().sum(-1).mean().sqrt())

    move = {(f, dx): _move(points, region, gravity, f, dx, 0.16) for f in FORMULATIONS for dx in dxs}
    assert size(move["total", dxs[1]]) > 0.001
    apart = [size(move["total", dx] - move["updated", dx]) for dx in dxs]
    assert apart[0] < sum(3 * size(move[f, dxs[0]] - move[f, dxs[1]]) for f in FORMULATIONS)
    assert apart[1] < 0.9 * apart[0]


@in_both
@pytest.mark.parametrize("law", ELASTIC)
def test_elastic_laws_vibrate_alike_at_small_strain_alone(law, formulation, device):
    """All linearise to the same material; at a strain of 1e-3 they differ by about that, and at 0.3 each is its own."""
    for speed, steps in ((0.02, 40), (2.4, 60)):
        ends = []
        for kind in ("corotated", law):
            points = _points((0.2, 0.2, 0.4), 0.05, ELASTIC[kind]).map(lambda t: t.to(device))
            velocity = torch.zeros_like(points.position)
            velocity[:, 2] = -speed * torch.cos(torch.pi * points.position[:, 2] / 0.4)
            solver = MPMSolver(0.1, formulation, gravity=ZERO)
            ends.append(solver.rollout(solver.init_state(points, velocity), 5e-4, steps).position - points.position)
        moved, apart = float(peak(ends[0])), float(peak(ends[0] - ends[1]))
        assert moved > 1e-4
        assert apart < 0.02 * moved if speed < 1 else apart > 0.05 * moved or law == "corotated"


def test_what_flows_is_refused_by_total():
    for law in PLASTIC.values():
        with value_error(rf"law {type(law).__name__} flows.*set `solver.formulation` to"):
            MPMSolver(0.1, "total").init_state(_points((0.2, 0.2, 0.2), 0.05, law))


def _stretched(formulation, points):
    solver = MPMSolver(0.1, formulation, gravity=ZERO)
    centre = points.position[:, :1].div(2.0, rounding_mode="floor") * points.position.new_tensor([2.0, 0, 0])
    velocity = 3.0 * (points.position - centre - 0.1) * points.position.new_tensor([1, -1, 0])
    return solver.rollout(solver.init_state(points, velocity), 5e-4, 60)


@pytest.mark.parametrize(
    ("formulation", "laws"),
    [("updated", [PLASTIC["sand"], PLASTIC["metal"], ELASTIC["neo-hookean"]]), ("total", [*ELASTIC.values()])],
    ids=FORMULATIONS[::-1],
)
def test_several_materials_in_one_run(formulation, laws):
    parts = []
    for k, law in enumerate(laws):
        place = _points((0.2, 0.2, 0.2), 0.05).position + 2.0 * double([k, 0, 0])
        parts.append(solid(place, 0.05**3, 100.0 + 50 * k, 1e4 + 1e4 * k, 0.3 + 0.1 * (k % 2), law=law))
    ends, joined = [_stretched(formulation, part) for part in parts], MaterialPoints.join(parts)
    order = torch.randperm(joined.count, generator=seeded(1))
    end = _stretched(formulation, joined.map(lambda t: t[order]))
    for name in ("position", "F_elastic", "F_total"):
        alone = torch.cat([getattr(e, name) for e in ends])[order]
        near(getattr(end, name), alone, 1e-11)
    if formulation == "updated":
        metal = torch.cat([torch.full((p.count,), float(k == 1)) for k, p in enumerate(parts)])[order].bool()
        assert ends[1].internal.max() > 1e-3
        near(end.internal[metal].sort()[0], ends[1].internal.sort()[0], 1e-11)
    assert peak(ends[0].F_total - ends[2].F_total) > 1e-3


def test_laws_and_indices_that_do_not_fit_are_refused():
    points = _points((0.2, 0.2, 0.2), 0.05)
    common = {"volume": 1e-3, "density": 1.0, "youngs_modulus": 1e3, "poisson_ratio": 0.3}
    with value_error(r"`law_index` to say which of the 2 `laws`"):
        MaterialPoints.create(points.position, **common, law=[PLASTIC["sand"], ELASTIC["neo-hookean"]])
    index = torch.full((points.count,), 2)
    with value_error(r"`law_index` to lie in 0 to 1"):
        MaterialPoints.create(points.position, **common, law=[PLASTIC["sand"], ELASTIC["neo-hookean"]], law_index=index)


@in_both
@pytest.mark.parametrize("law", ["corotated", "neo-hookean"])
def test_an_elastic_run_computes_no_eigenvectors_and_no_return_map(law, formulation, monkeypatch):
    """These laws must stay cheap, and state fields exist only if a scene needs them."""

    def forbidden(*_, **__):
        raise AssertionError("not needed in an elastic run")

    files = [import_module(f"{laws.__name__}.{found.name}") for found in iter_modules(laws.__path__)]
    for name in ("spectrum", "from_principal", "_singular_vectors"):
        for home in (linalg, *files):
            monkeypatch.setattr(home, name, forbidden, raising=False)
    for home, name in ((dispatch.LawDispatch, "return_map"), (torch.linalg, "svd"), (torch.linalg, "eigh")):
        monkeypatch.setattr(home, name, forbidden)
    points = _points((0.2, 0.2, 0.2), 0.05, ELASTIC[law])
    solver = MPMSolver(0.1, formulation, transfer="torch")
    state = solver.init_state(points, 2.0 * points.position)
    steps = solver.substeps(state, 0.02)
    state = solver.rollout(state, 0.02 / steps, steps)
    assert state.F_total is state.F_elastic
    assert state.internal is None


@in_both
def test_what_is_bound_does_not_change(formulation):
    """The formulation has the same settings, so they cannot be set on the solver alone."""
    solver = MPMSolver(0.1, formulation)
    with pytest.raises(AttributeError):
        solver.stiffness_damping = 1.0
    assert solver.neighbours_fixed == (formulation == "total")
    points = _points((0.2, 0.2, 0.2), 0.05)
    solver.init_state(points)
    first = solver.bound
    solver.init_state(points)
    assert solver.bound is not first
