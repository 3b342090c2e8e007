from importlib import import_module
from pkgutil import iter_modules

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import ZERO, double, in_both, near, peak, seeded, solid, value_error

from gaussian_swaying import MaterialPoints, MPMSolver
from gaussian_swaying.geometry import linalg
from gaussian_swaying.mpm import dispatch, laws

FORMULATIONS = ["total", "updated"]


def _points(size, spacing, law=None, e=1e4, density=100.0, thickness=None):
    axes = [(torch.arange(max(round(side / spacing), 1)).double() + 0.5) * spacing for side in size]
    position = torch.cartesian_prod(*axes)
    volume = spacing**3 if thickness is None else spacing**2 * thickness
    return solid(position, volume, density, e, law=law)


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
