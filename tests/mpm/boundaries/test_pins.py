import dataclasses
import math
import warnings
from itertools import pairwise

import pytest
import torch
from shared import (
    EYE,
    ZERO,
    Chosen,
    alike,
    beyond,
    double,
    in_both,
    longest,
    near,
    peak,
    randn,
    seeded,
    solid,
    turned_by,
    up_to,
    user_warning,
    value_error,
)
from torch.testing import assert_close

from gaussian_swaying import Box, MPMSolver, PinnedPoints, PinnedRegion
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Everything, HalfSpace, Sphere
from gaussian_swaying.mpm import pins as pinning
from gaussian_swaying.mpm.colliders import Obstacle, Wall
from gaussian_swaying.mpm.pins import (
    MOST_ROWS,
    SOFTENED,
    along_face,
    face,
    thickness,
)
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import bspline_stencil, gather

DX, STEP = 0.1, 0.045
TOP = beyond(z=-0.03)


def _sheet(dtype=torch.float64, layers=1, width=8, height=10, turn=0.0, shift=(0.0, 0.0, 0.0), e=4e3):
    """A sheet in the x-z plane that hangs down from z = 0."""
    x = STEP * (torch.arange(width).double() + 0.5)
    z = -STEP * (torch.arange(height).double() + 0.5)
    y = 0.01 * double([0.0] if layers == 1 else [-1.0, 0.0, 1.0])
    rest = torch.cartesian_prod(x, y, z)
    c, s = math.cos(turn), math.sin(turn)
    matrix = double([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    position = (rest @ matrix.T + double(shift)).to(dtype)
    return solid(position, STEP**2 * 0.02 / layers, 100.0, e)


def _read(place, state, name="node_velocity"):
    field = getattr(state, name)
    return gather(field, bspline_stencil(torch.as_tensor(place, dtype=field.dtype), state.grid, False))


def _run(solver, points, steps, dt=1e-3, force=None, velocity=None, every=1):
    states = [solver.init_state(points, velocity)]
    for _ in range(steps // every):
        state = states[-1]
        for _ in range(every):
            state = solver.step(state, dt, force=force)
        states.append(state)
    return states


def _push(points, size=0.02):
    generator = seeded(1)
    push = size * randn(points.position.shape, generator=generator)
    return push.to(points.position) + points.position.new_tensor([0.0, size / 3, 0.0])


def _started(points, *boundaries, **settings):
    solver = MPMSolver(DX, boundaries=boundaries, **settings)
    solver.init_state(points)
    return solver


def _rows(solver):
    return pinning.Rows(*(field[0, 0] for field in solver.bound.pinned_rows.rows))


def _own_places(solver):
    rows = _rows(solver)
    return rows.place[~rows.slope]


# ---- what is held


AT = [[0.013, 0.0, -0.001], [0.31, 0.0, -0.017], [0.2, 0.0, -0.3]]  # which need not be particles


@pytest.mark.slow(gate=["3-clamp-dtype0-1e-14", "3-hinge-dtype1-2e-07", "1-hinge-dtype0-1e-14", "1-clamp-dtype1-2e-07"])
@pytest.mark.parametrize(("dtype", "most"), [(torch.float64, 1e-14), (torch.float32, 2e-7)])
@pytest.mark.parametrize("kind", ["hinge", "clamp"])
@pytest.mark.parametrize("layers", [1, 3])
def test_held_points_stay_where_they_are(kind, dtype, most, layers):
    points = _sheet(dtype, layers)
    for pin, across in ((PinnedRegion(TOP, kind), 1), *([] if layers == 3 else [(PinnedPoints(AT, kind), slice(3))])):
        solver = MPMSolver(DX, boundaries=[pin])
        state = _run(solver, points, 200, force=_push(points), every=200)[-1]
        rows = _own_places(solver) if across == 1 else AT
        moved = _read(rows, state, "node_displacement")
        assert peak(state.node_displacement) > 0.02
        assert len(rows) >= 3
        assert peak(moved[:, 0]) < most
        # a clamp holds the section: it cannot turn about the line, up to rows that nearly depend on the others; at
        # single places it holds all slopes
        slopes = moved[:, 1:].abs().amax((0, 2))[across].max()
        assert (float(slopes) < (0.05 if across == 1 else 100 * most)) == (kind == "clamp")


def _strip(shift):
    """Two rows of points, which within a cell would hold the slope; so would points at two heights of a sheet."""
    points = _sheet(layers=3, width=20, shift=(0.013, shift, shift))
    return points, points.position[:, 2] > shift - 2 * STEP, (0.0, 1.0, 0.0, shift), (8, 10)


def _thick(turn):
    """1.04 cells: faces of three layers lie in other cells than the middle, and held as well would hold the slope."""
    points = _sheet(layers=3, width=20, turn=turn)
    share = torch.where(points.position[:, 1] == 0, 2.0, 0.5)  # Simpson's weights
    place = points.position * double([1.0, 5.2, 1.0])
    points = dataclasses.replace(points, position=place, mass=share * points.mass, volume=share * points.volume)
    top = place[:, 2] - math.tan(turn) * place[:, 0] > -0.6 * STEP / math.cos(turn)
    return points, top, (0.0, 1.0, 0.0, 0.0), (7, 20 * STEP / pinning.LEAST_APART / DX + 1)


def _across(yaw):
    """Across the grid, where cells cut the layers so that each of them has some points only."""
    flat = _sheet(layers=3, width=40)
    x, y, z = flat.position.unbind(-1)
    c, s = math.cos(yaw), math.sin(yaw)
    points = dataclasses.replace(flat, position=torch.stack([c * x - 3 * s * y, s * x + 3 * c * y, z], -1))
    return points, z > -STEP, (-s, c, 0.0, 0.0), (40 * STEP / DX / 2, 99)


@pytest.mark.parametrize(
    ("make", "number"),
    [(_strip, n) for n in (0.0, 0.02, 0.04, 0.06, 0.08)]
    + [(_thick, n) for n in (0.0, 0.4)]
    + [(_across, n) for n in (0.2, 0.6, 1.0)],
)
def test_a_hinge_is_a_line_in_the_middle_plane(make, number):
    points, top, (a, b, c, d), (least, most) = make(number)
    solver = _started(points, PinnedRegion(Chosen(top), "hinge"))
    rows = solver.bound.pinned_rows.rows.place.reshape(-1, 3)
    assert peak(rows @ double([a, b, c]) - d) < 1e-9
    if make is _strip:
        near(rows[:, 2], torch.full_like(rows[:, 2], number - STEP), 1e-12)
    assert least <= len(rows) <= most


@pytest.mark.parametrize("shift", [0.0, 0.2, 0.4, 0.45, 0.6, 0.8])
def test_a_place_just_outside_extends_the_nearest_cell(shift):
    """A linear field is read exactly, although nodes beyond the material have no mass and do not move."""
    points = _sheet(shift=(0.0, 0.0, shift * DX))
    solver = MPMSolver(DX, boundaries=[PinnedPoints([[0.2, 0.0, shift * DX]])])
    state = solver.init_state(points)
    field = state.grid.node_positions(state.position)
    massive = solver.bound.node_mass > 0
    node, weight = (values[0] for values in _rows(solver)[:2])
    seen = weight @ torch.where(massive[:, None], field, 1e6)[node]
    assert massive[node[weight != 0]].all()
    near(seen, double([0.2, 0.0, shift * DX]), 1e-13)


def test_places_are_converted_from_scene_units():
    scene = _sheet().position * 3 + 5
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    points = dataclasses.replace(_sheet(), position=frame.point_to_sim(scene))
    at = [[5.1, 5.0, 4.9]]
    solver = MPMSolver(DX, boundaries=[PinnedPoints(at)])
    solver.init_state(points, frame=frame)
    expected = frame.point_to_sim(double(at))
    near(_own_places(solver), expected, 1e-13)


# ---- which rows are kept


def _condition(holds):
    worst = 1.0
    for w in holds.W.flatten(0, 1):
        w = w[: int((w.diagonal() != 0).sum())]
        product = torch.linalg.inv(w[:, : len(w)].T @ w[:, : len(w)])
        scale = product.diagonal().rsqrt()
        values = torch.linalg.eigvalsh(scale[:, None] * product * scale)
        worst = max(worst, float(values[-1] / values[0]))
    return worst


@pytest.mark.parametrize("patch", [1, 2, 8])
@pytest.mark.parametrize(("kind", "most"), [("hinge", 50.0), ("clamp", 1000.0)])
def test_kept_rows_are_independent_at_any_angle(kind, most, patch):
    generator = seeded(patch)
    worst = 0.0
    for k in range(8):
        turn = [0.0, math.pi / 4, math.pi / 2][k] if k < 3 else math.pi * float(torch.rand((), generator=generator))
        shift = (DX * torch.rand(3, generator=generator)).tolist()
        points = _sheet(layers=1 + 2 * (k % 2), width=20, turn=turn, shift=shift)
        height = _sheet(layers=1 + 2 * (k % 2), width=20).position[:, 2]
        pin = PinnedRegion(Chosen(height > -STEP * patch), kind)
        solver = _started(points, pin)
        assert (_rows(solver).release > 0).sum() >= 0.8 * 20 * STEP / DX
        worst = max(worst, _condition(solver.bound.pinned_rows))
    assert 1.5 < worst < most


def test_a_line_along_the_grid_keeps_all_its_cells():
    points = _sheet(width=22, shift=(0.05, 0.02, 0.03))
    solver = _started(points, PinnedRegion(beyond(z=-0.001), "hinge"))
    line = _own_places(solver)
    held = points.position[points.position[:, 2] > -0.001]
    assert len(line) == len(torch.unique(torch.floor(held / DX - 0.5), dim=0))
    rows = _rows(_started(points, PinnedPoints(line.tolist(), "clamp")))
    slope = rows.slope
    assert (~slope).sum() == len(line)
    along = rows.place[slope][:, 0] > 0
    assert int(along.sum()) <= 2  # the slope along the line depends on the values, except at its ends
    assert int(slope.sum()) >= 2 * len(line)


def test_pins_in_the_same_cells_agree():
    """Each alone would move the points of the other."""
    points = _sheet()
    at = [[0.1, 0.0, -0.09], [0.2, 0.0, -0.15]]
    pins = [PinnedRegion(TOP), PinnedPoints(at), PinnedRegion(Box([0.3, None, -0.2], [None, None, -0.1]), "clamp")]
    solver = MPMSolver(DX, boundaries=[*pins, Wall(HalfSpace([0, 0, -0.42], [0, 0, 1]), "slip")])
    state = _run(solver, points, 200, force=_push(points), every=200)[-1]
    places = _own_places(solver)
    assert len(places) >= 7
    assert peak(_read(places, state, "node_displacement")[:, 0]) < 1e-14
    assert state.impulse.shape == (4, 3)
    assert (state.impulse[:3].abs().amax(-1) > 0).all()


# ---- motion and time


@pytest.mark.slow(gate=["hinge"])
@pytest.mark.parametrize("kind", ["hinge", "clamp"])
def test_a_handle_moves_its_points_exactly(kind):
    """720 degrees about a travelling pivot; a clamp also turns the deformation gradient."""
    points = _sheet(layers=3)
    velocity, pivot, rate, steps, dt = [0.2, -0.1, 0.3], [0.1, 0.05, 0.02], 2 * math.pi, 2000, 1e-3
    handle = PinnedRegion(TOP, kind, velocity=velocity, angular_velocity=[0.0, 0.0, rate], pivot=pivot)
    solver = MPMSolver(DX, boundaries=[handle])
    states = _run(solver, points, steps, dt, every=500)
    rest = _own_places(solver)
    for state in states[1:]:
        time = float(state.time)
        turn = turned_by(math.degrees(rate * time))
        centre = double(pivot)
        wanted = centre + time * double(velocity) + (rest - centre) @ turn.T
        rows = _read(rest, state, "node_displacement")
        near(rest + rows[:, 0], wanted, 1e-11)
        F = rows[:, 1:].mT + EYE
        # the slope along the line of points is theirs up to the bending of the line between them, and that across the
        # face is free; the section turns as the handle does
        error = peak((F - turn)[:, :, 1])
        assert (float(error) < 1e-9) == (kind == "clamp")


def test_of_two_boundaries_at_the_same_place_the_last_one_counts():
    points = _sheet()
    for boundaries, speed in (
        ([PinnedRegion(TOP), PinnedRegion(TOP, velocity=[0, 1, 0])], 1.0),
        ([PinnedRegion(TOP, velocity=[0, 1, 0]), PinnedRegion(TOP)], 0.0),
    ):
        solver = MPMSolver(DX, boundaries=boundaries)
        state = _run(solver, points, 2)[-1]
        found = _read(_own_places(solver), state)[:, 0]
        assert_close(found, double([[0.0, speed, 0.0]]).expand_as(found))


def test_pins_act_within_their_windows():
    points = _sheet()
    dt = 1e-3
    pins = [
        PinnedRegion(TOP, end=0.1495),
        PinnedPoints([[0.1, 0.0, -0.25]], start=0.0495, end=0.0995),
        PinnedPoints([[0.3, 0.0, -0.3], [0.1, 0.0, -0.25]], start=0.0795),
    ]
    solver = MPMSolver(DX, boundaries=pins)
    states = _run(solver, points, 200, dt, force=_push(points))
    assert solver.bound.pinned_rows.starts.tolist() == [0.0495, 0.0795]
    for places, first, last in ((None, 0, 149), ([[0.1, 0.0, -0.25]], 50, 200), ([[0.3, 0.0, -0.3]], 80, 200)):
        places = _own_places(solver) if places is None else places
        speed = torch.stack([peak(_read(places, s)[:, 0]) for s in states])
        assert (speed[1:] < 1e-13)[first:last].all(), (places, first, last)
        assert (speed[1 : first + 1] < 1e-6).sum() == 0
        assert (speed[last + 3 :] < 1e-6).sum() == 0
    taken = torch.stack([s.impulse for s in states])
    changes = (taken[1:] != taken[:-1]).any(-1)
    assert changes[:, 0].nonzero()[:, 0].tolist() == list(range(150))
    # where two hold the same place, the one that holds longer carries it
    assert changes[:, 1].nonzero()[:, 0].tolist() == list(range(50, 80))
    assert int(changes[:80, 2].sum()) == 0
    assert changes[80:, 2].all()


def test_points_are_released_one_by_one():
    points = _sheet(width=12)
    release = PinnedRegion(TOP, front=[[1.0, 0.0, 0.0]], start=0.02, end=0.12)
    solver = MPMSolver(DX, boundaries=[release])
    states = _run(solver, points, 160)
    rest, when = _own_places(solver), _rows(solver).release
    assert when.tolist() == sorted(when.tolist(), reverse=True)
    assert len(set(when.tolist())) == len(torch.unique(torch.floor(rest[:, 0] / DX - 0.5)))
    held = TOP.contains(points.position)
    low, high = points.position[held, 0].min(), points.position[held, 0].max()
    alike(when, 0.02 + 0.1 * (rest[:, 0] - low) / (high - low), 1e-12)
    for state in states[40::40]:
        time = float(state.time) - 1e-3
        moved = _read(rest, state, "node_displacement")[:, 0].norm(dim=-1)
        assert torch.equal(moved < 1e-13, when > time + 1e-9)


@pytest.mark.slow(gate=["hinge-5", "clamp-5"])
@pytest.mark.parametrize("hundreds", [5, 40])
@pytest.mark.parametrize("kind", ["hinge", "clamp"])
def test_the_longest_proven_substep_stays_stable(kind, hundreds):
    points = _sheet(layers=3, e=1e5)
    solver = MPMSolver(DX, boundaries=[PinnedRegion(TOP, kind)], gravity=ZERO)
    generator = seeded(2)
    velocity = 1e-3 * randn(points.position.shape, generator=generator)
    state = solver.init_state(points, velocity)
    dt = solver.stable_substep(state)
    first = solver.rollout(state, dt, 20)
    before = sum(float(e) for e in solver.energies(first).values())
    largest = 0.0
    state = first
    for _ in range(hundreds):
        state = solver.rollout(state, dt, 100)
        largest = max(largest, sum(float(e) for e in solver.energies(state).values()))
    assert 0 < largest < 6 * before


# ---- the support


@in_both
def test_supports_take_the_momentum_of_the_forces(formulation):
    """In every substep: momentum gained = gravity - what the boundaries took."""
    points = _sheet()
    ball = Obstacle(Sphere([0.2, 0.05, -0.3], 0.1), path=KeyedPath([0.0, 1.0], [[0, 0, 0], [0.1, -2.0, 0.3]]))
    pins = [PinnedRegion(TOP), Wall(HalfSpace([0, 0, -0.41], [0, 0, 1]), "separate", 0.3), ball]
    solver = MPMSolver(DX, formulation, boundaries=pins)
    states = _run(solver, points, 60, 1e-3)
    weight = float(points.mass.sum()) * double([0, 0, -9.8])
    for a, b in pairwise(states):
        gained = solver.momenta(b)["linear"] - solver.momenta(a)["linear"]
        taken = (b.impulse - a.impulse).sum(-2)
        near(gained, weight * 1e-3 - taken, 1e-14)
    assert states[-1].impulse.dtype == torch.float64
    assert float(states[-1].impulse[0, 2]) < 0
    assert states[-1].impulse[2].norm() > 0.1 * float(weight.norm()) * 0.06


# ---- gradients, batches, bits


# ---- kinds and errors


def test_a_subclass_with_its_own_forward_acts_on_nodes():
    class Stopper(PinnedRegion):
        def forward(self, velocity, nodes):
            return torch.where(nodes.pinned[..., None], 0.0, velocity)

    class Lifter(PinnedRegion):
        def target(self, place, time, dt):
            return torch.ones_like(place)

    solver = MPMSolver(DX, boundaries=[Stopper(TOP), Lifter(up_to(z=-0.4))])
    state = _run(solver, _sheet(), 3, every=3)[-1]
    assert solver.bound.kinds == ("nodes", "hinge")
    speed = _read(_own_places(solver), state)[:, 0]
    near(speed, torch.ones_like(speed), 1e-13)


UPDATED = {"formulation": "updated"}


@pytest.mark.parametrize(
    ("pin", "settings", "message"),
    [
        (
            PinnedRegion(TOP, kind="clamp"),
            UPDATED,
            r"`kind: clamp` of the PinnedRegion needs .* set `kind` to nodes, or `solver.formulation` to total",
        ),
        (
            PinnedPoints([[0, 0, 0]]),
            UPDATED,
            r"Pinned points of the PinnedPoints .* set the boundary to a PinnedRegion",
        ),
        (
            PinnedPoints([[0.1, 0.0, -0.1], [0.1, 0.3, -0.1]]),
            {},
            "place 1 of `at` of the PinnedPoints has no material around it",
        ),
        (
            PinnedRegion(Everything()),
            {},
            r"hold \d+ points and slopes, more than the 9 .* `kind` of the PinnedRegion to",
        ),
    ],
)
def test_what_cannot_be_pinned_is_refused(pin, settings, message, monkeypatch):
    monkeypatch.setattr(pinning, "MOST_ROWS", 9)
    with value_error(message):
        _started(_sheet(), pin, **settings)


def _box(x, y, z, step=0.25, turn=0.0):
    """Points in a box of so many cells, one corner at the origin, turned about y."""
    axes = [(torch.arange(max(round(side / step), 1)).double() + 0.5) * step * DX for side in (x, y, z)]
    rest = torch.cartesian_prod(*axes)
    c, s = math.cos(turn), math.sin(turn)
    return rest @ double([[c, 0, -s], [0, 1, 0], [s, 0, c]]).T


def _material(rest):
    return solid(rest, 1e-5)


# ---- the face


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_face_lies_between_held_and_free_points(turn):
    rest = _box(6, 1, 2)
    held = rest[:, 0] < 0.2
    place, across = face(_box(6, 1, 2, turn=turn), held, DX)
    c, s = math.cos(turn), math.sin(turn)
    normal = double([c, 0.0, s])
    assert len(place) == 4 * 8  # each held point of the last layer has its partner
    near(place @ normal, torch.full((32,), 0.2, dtype=torch.float64), 1e-12)
    near(across, normal.expand_as(across), 1e-12)


def test_a_large_face_takes_larger_patches():
    """60 x 60 cells have 14,400 patches of half a cell; their rows would not fit."""
    rest = _box(2, 60, 60, step=0.5)
    solver = _started(_material(rest), PinnedRegion(Chosen(rest[:, 0] < DX), "clamp"))
    assert 100 < solver.bound.pinned_rows.W.shape[-1] <= MOST_ROWS


# ---- sheet or solid


@pytest.mark.parametrize(
    ("sides", "thick", "sheet"),
    [
        ((20, 12, 0.5), 0.5, True),
        ((20, 12, 1), 1.0, True),
        ((20, 12, 2), 2.0, False),
        ((20, 1, 0.5), 0.5, False),  # a cord
        ((20, 1, 2), 1.0, False),  # a beam in plane strain
        ((20, 12, 8), None, False),
    ],
)
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_sheet_is_thin_and_wide(sides, thick, sheet, turn):
    rest, points = _box(*sides), _box(*sides, turn=turn)
    found, thin = thickness(points, torch.ones(len(points)), points[rest[:, 0] < DX], DX)
    assert thin == sheet
    if thick is not None:  # layers of points have the moment of a body that is thinner by 1 - 1 / m²
        layers = round(thick / 0.25)
        assert found == pytest.approx(thick * DX * math.sqrt(1 - 1 / layers**2), rel=0.02)


def test_the_default_holds_a_sheet_by_a_hinge_and_a_solid_by_a_clamp():
    kinds = {}
    for name, sides in (("sheet", (12, 12, 0.5)), ("solid", (12, 2, 2)), ("cord", (12, 0.5, 0.5))):
        rest = _box(*sides)
        solver = _started(_material(rest), PinnedRegion(up_to(x=0.07)), PinnedRegion(Everything()))
        kinds[name] = solver.bound.kinds[0]
    assert kinds == {"sheet": "hinge", "solid": "face", "cord": "face"}


def test_what_cannot_hold_is_warned_of_at_the_start():
    solid = _material(_box(12, 2, 2))
    with user_warning(r"`kind: hinge` of the PinnedRegion .* 2 cells thick.* set `kind` to clamp"):
        _started(solid, PinnedRegion(up_to(x=0.07), "hinge"))
    with user_warning(r"`kind: clamp` of the PinnedPoints .* still turns: use a PinnedRegion"):
        _started(solid, PinnedPoints([[0.05, 0.1, 0.1]], "clamp"))


@pytest.mark.parametrize("shift", [0.0, 0.03])
@pytest.mark.parametrize(("rows", "wide"), [(2, False), (4, False), (6, True), (12, True)])
def test_a_hinge_that_holds_several_lines_is_warned_of(rows, wide, shift):
    """Rows of points lie a quarter of a cell apart; lines closer than 0.6 cells are joined."""
    rest = _box(20, 12, 0.5) + torch.tensor([shift, 0.0, 0.0])
    region = up_to(x=shift + 0.25 * rows * DX)
    solver = MPMSolver(DX, boundaries=[PinnedRegion(region, "hinge")])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        solver.init_state(_material(rest))
    along = _own_places(solver)[:, 0].sort()[0]
    assert (float(along[-1] - along[0]) > 0.3 * DX) == wide
    said = [str(one.message) for one in told if "holds several lines and with them the slope" in str(one.message)]
    assert bool(said) == wide


# ---- a clamped solid


def test_held_material_is_soft_and_takes_its_weight():
    rest = _box(8, 1, 2)
    points = _material(rest)
    solver = MPMSolver(DX, boundaries=[PinnedRegion(up_to(x=0.4))])
    state = solver.init_state(points)
    held = rest[:, 0] < 0.4
    mu = solver.laws.mu
    assert_close(mu[held], SOFTENED * mu[~held][:1].expand(int(held.sum())))
    assert torch.equal(solver.points.youngs_modulus, points.youngs_modulus)
    after = solver.rollout(state, 1e-3, 60)
    weight = double([0.0, 0.0, -9.8]) * points.mass.sum()
    gained = solver.momenta(after)["linear"]
    near(gained, 0.06 * weight - after.impulse[0], 1e-12)
    assert float(after.impulse[0, 2]) < 0.5 * 0.06 * float(weight[2])  # at least what lies in the region
    assert longest((after.position - rest)[rest[:, 0] < 0.05]) < 1e-12


def test_a_clamp_that_opens_keeps_its_stiffness():
    rest = _box(8, 1, 2)
    pin = PinnedRegion(up_to(x=0.4), "clamp", end=0.05)
    solver = MPMSolver(DX, boundaries=[pin])
    state = solver.init_state(_material(rest))
    assert len(solver.laws.mu.unique()) == 1
    held = solver.rollout(state, 1e-3, 50)
    assert longest((held.position - rest)[rest[:, 0] < 0.05]) < 1e-12
    fallen = solver.rollout(held, 1e-3, 100)
    assert (fallen.velocity[:, 2] < -0.5).all()


def test_groups_are_joined_until_they_are_apart():
    place = double([0.0, 0.1, 0.32, 0.9, 1.0, 2.0])
    position = torch.nn.functional.pad(place[:, None], (0, 2))
    mass, cell = torch.ones(6).double(), torch.tensor([7, 7, 8, 9, 9, 12])
    assert pinning.groups(position, mass, cell, 0.2).tolist() == [0, 0, 1, 2, 2, 3]
    assert pinning.groups(position, mass, cell, 0.3).tolist() == [0, 0, 0, 1, 1, 2]
    assert pinning.groups(position, mass, cell, 0.9).tolist() == [0, 0, 0, 0, 0, 1]
    assert pinning.groups(position[:0], mass[:0], cell[:0], 0.3).tolist() == []
    heavy = double([1.0, 1, 1, 1, 3, 1])
    found = pinning.means(position, heavy, torch.tensor([0, 0, 0, 1, 1, 2]))
    assert_close(found[:, 0], double([0.14, 0.975, 2.0]))


@pytest.mark.parametrize(
    ("place", "massless", "first"),
    [
        # on the border of the cell with the nodes 2, 3 and 4, and e beyond: the largest weight at the fourth is
        # e^2 / 2 times 0.75 for each other axis, and does not count below 1e-6
        (2.5, (4,), 2),
        (2.5 + math.sqrt(0.95e-6 / (0.5 * 0.75**2)), (4,), 2),
        (2.5 + math.sqrt(1.05e-6 / (0.5 * 0.75**2)), (4,), 1),
        (2.95, (), 2),
        (2.95, (4,), 1),  # the cell before, though the place lies nearly half a cell beyond it
        (2.95, (2,), 3),
        (2.95, (2, 4), -1),  # beyond the cell before, the weight of its node 2 is -0.15: it does count
    ],
)
def test_a_cell_beside_a_place_has_all_the_nodes_that_it_needs(place, massless, first):
    grid = GridSpec(0.5, (-1, 2, 0), (7, 6, 8))
    for axis in range(3):
        node = double([3.0] * 3)
        node[axis] = place
        position = 0.5 * (node + torch.tensor(grid.offset))
        index = torch.cartesian_prod(*(torch.arange(count) for count in grid.resolution))
        massive = ~torch.isin(index[:, axis], torch.tensor(massless, dtype=torch.long))
        found = int(pinning.cells_of_places(position[None], grid, massive))
        if first == -1:
            assert found == -1
        else:
            expected = [2, 2, 2]
            expected[axis] = first
            assert index[found].tolist() == expected


def test_what_is_far_apart_has_no_face():
    rest = torch.cat([_box(1, 1, 1), _box(1, 1, 1) + 0.35])
    held = torch.arange(len(rest)) < len(rest) // 2
    assert len(face(rest, held, DX)[0]) == 0
    assert len(face(rest, torch.ones_like(held), DX)[0]) == 0
    assert len(face(rest, held, 4 * DX)[0]) > 0


def test_slopes_lie_along_the_face_or_are_all_three():
    normal = double([[0.0, 0.6, 0.8], [0.1, 0.0, 0.0]])
    some, every = along_face(normal)
    assert_close(some[:2] @ some[:2].T, torch.eye(2).double())
    near(some @ normal[0], torch.zeros(3).double(), 1e-15)
    assert (some[2] == 0).all()
    assert torch.equal(every, EYE)
