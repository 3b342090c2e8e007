"""Stiffness, mass and modes of a body at rest, against its energy and beam theory."""

import math

import numpy as np
import pytest
import torch
from shared import ZERO, alike, beyond, near, rand, randn, seeded, solid, up_to, value_error

from gaussian_swaying import Box, MaterialPoints, MPMSolver, PinnedRegion
from gaussian_swaying.mpm import modal
from gaussian_swaying.mpm.laws.elastic import FixedCorotated, NeoHookean, StVKHencky
from gaussian_swaying.mpm.modal import LOOSE, Structure, analysis_of
from gaussian_swaying.mpm.pins import RigidRegion

FOOT = up_to(z=0.1)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(modal, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def lattice(low, high, spacing):
    axes = [
        torch.arange(round((b - a) / spacing)).double() * spacing + a + 0.5 * spacing
        for a, b in zip(low, high, strict=True)
    ]
    return torch.cartesian_prod(*axes)


def post(spacing=0.05, E=2e5, density=100.0, law=None, nu=0.3, extra=(), width=0.2, stiff=(slice(0), 1.0)):
    """A square post of 1 m that is held at its foot, with further blocks."""
    position = torch.cat([lattice((0, 0, 0), (width, width, 1), spacing), *extra])
    E = torch.full((len(position),), E, dtype=torch.float64)
    E[stiff[0]] *= stiff[1]
    return solid(position, spacing**3, density, E, nu, law=law)


def bound(points, dx=0.1, boundaries=None, formulation="total"):
    boundaries = [PinnedRegion(FOOT)] if boundaries is None else boundaries
    solver = MPMSolver(dx, formulation, gravity=ZERO, boundaries=boundaries, transfer="torch")
    solver.init_state(points)
    return solver


@pytest.mark.parametrize("law", [FixedCorotated, NeoHookean, StVKHencky])
def test_the_stiffness_is_the_second_derivative_of_the_energy(law):
    """By central differences: the error is that of the fourth derivative, 1e-8 at a strain of 1e-4, and rounding."""
    generator = seeded(0)
    points = post(law=law(), stiff=(slice(None), 1 + rand(320, generator=generator)))
    solver = bound(points)
    rest = solver.init_state(points)
    total = solver.bound
    structure = Structure(total)
    K = structure.mean_modulus * structure.hooke()
    some = torch.rand(320, generator=generator).numpy() < 0.3
    both = structure.mean_modulus * (structure.hooke(some) + structure.hooke(~some))
    assert abs(both - K).max() < 1e-12 * abs(K).max()

    def energy(u):
        return float(solver.elastic_energy(total.read_particles(rest, u, torch.zeros_like(u))))

    step = 1e-5  # over dx = 0.1
    for _ in range(4):
        u = randn(total.grid.node_count, 3, generator=generator)
        second = (energy(step * u) + energy(-step * u) - 2 * energy(0 * u)) / step**2
        flat = u.flatten().numpy()
        assert flat @ (K @ flat) == pytest.approx(second, rel=1e-5)


def test_the_first_frequency_is_that_of_a_beam():
    """Euler and Bernoulli: omega = 1.8751² sqrt(E I / (rho A)) / L².

    The grid of two cells across bends at quadratic order; a pin of whole nodes is up to half a cell of 0.05 m longer or
    shorter than its region, 5 % of the frequency, and shear takes 2 %.
    """
    solver = bound(post(spacing=0.025, nu=0.0, width=0.1), dx=0.05, formulation="modes")
    exact = 1.8751**2 * math.sqrt(2e5 / 100.0) * 0.1 / math.sqrt(12) / 0.9**2
    assert solver.bound.first == pytest.approx(exact, rel=0.07)


def test_a_factor_of_stiffness_or_mass_is_exact_and_needs_no_analysis(cache, monkeypatch):
    pin = [PinnedRegion(FOOT, kind="nodes")]  # which points a clamp picks of a symmetric body, rounding decides
    first = bound(post(), boundaries=pin, formulation="modes").bound
    assert len(list(cache.glob("modes_*.npz"))) == 1
    monkeypatch.setattr(Structure, "analyse", lambda *given: pytest.fail("it is in the cache"))
    stiffer = bound(post(E=8e5), boundaries=pin, formulation="modes").bound
    alike(stiffer.square, 4 * first.square, 1e-14)
    assert stiffer.first == pytest.approx(2 * first.first, rel=1e-14)
    near(stiffer.shape, first.shape, 0)
    for density in (100.001, 237.3):  # rounding is no other body
        bound(post(density=density), boundaries=pin, formulation="modes")
    heavier = bound(post(density=400.0), boundaries=pin, formulation="modes").bound
    alike(heavier.square, first.square / 4, 1e-14)
    alike(heavier.shape, first.shape / 2, 1e-14)


def test_what_is_in_the_cache_is_the_same_to_the_bit_and_a_damaged_file_is_ignored(cache):
    total = bound(post()).bound
    first = analysis_of(total, 0, 20)
    (file,) = cache.glob("modes_*.npz")
    again = analysis_of(total, 0, 20)
    for name in vars(first):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    for content in (b"", b"no archive", file.read_bytes()[:500]):
        file.write_bytes(content)
        found = analysis_of(total, 0, 20)
        np.testing.assert_allclose(found.square, first.square, rtol=1e-10)
        assert len(file.read_bytes()) > 1000
    assert analysis_of(total, 0, 5).square.shape == (5,)
    other = post(stiff=(slice(40), 3))
    assert len(list(cache.glob("modes_*.npz"))) == 2
    assert analysis_of(bound(other).bound, 0, 20).first < 0.95 * first.first  # for the same mean stiffness


def test_only_the_last_analyses_are_kept(cache, monkeypatch):
    monkeypatch.setattr(modal, "KEPT", 2)
    total = bound(post()).bound
    for most in (3, 4, 5):
        analysis_of(total, 0, most)
    assert len(list(cache.glob("modes_*.npz"))) == 2


def test_modes_are_orthonormal_and_ascend():
    structure = Structure(bound(post()).bound)
    found = structure.analyse(30)
    u = np.zeros((structure.nodes, 3, len(found.square)))
    u[found.node] = found.shape.reshape(-1, 3, len(found.square))
    u = u.reshape(3 * structure.nodes, -1)
    mass = np.repeat(structure.mass, 3)[:, None]
    np.testing.assert_allclose(u.T @ (mass * u), np.eye(u.shape[1]), atol=1e-9)
    scale = np.sqrt(np.outer(found.square, found.square))
    np.testing.assert_allclose(u.T @ (structure.stiffness @ u) / scale, np.eye(u.shape[1]), atol=1e-7)
    assert (np.diff(found.square) >= 0).all()
    assert found.square[0] >= LOOSE**2 * found.first
    assert not u.reshape(structure.nodes, -1)[structure.pinned >= 0].any()


def test_a_piece_that_nothing_holds_follows_the_nearest_that_is_held():
    """A crumb beside the post would have six modes of no stiffness; it turns with the post as if glued to it."""
    crumb = lattice((0.6, 0, 0.8), (0.7, 0.1, 0.9), 0.05)
    points = post(extra=[crumb], nu=0.0)
    structure = Structure(bound(points).bound)
    assert len(structure.loose) == 3
    found = structure.analyse(40)
    alone = Structure(bound(post(nu=0.0)).bound).analyse(40)
    assert found.dropped <= alone.dropped
    # 8 of 328 points, at 0.85 of the height, where the first mode moves by some 0.78: its square is lower by
    # 1 + 8 / 320 x 4 x 0.78² = 1.06, as the effective mass of a cantilever is a quarter, and by what swings around it
    assert 0.8 < found.first / alone.first * 320 / 328 < 0.96  # for the same post, of 320 / 328 kg
    first = int(np.argmin(abs(found.square - found.first)))
    shift = found.site_shape.reshape(-1, 3, len(found.square))[:, :, first][found.site]
    turn = found.site_turn.reshape(-1, 3, len(found.square))[:, :, first][found.site]
    own, place = len(points.position) - 8, points.position.numpy()
    host = np.linalg.norm(place[:own] - place[own:].mean(0), axis=1).argmin()
    rigid = shift[host] + np.cross(turn[host], place[own:] - place[host])
    np.testing.assert_allclose(shift[own:], rigid, atol=0.1 * abs(shift[own:]).max())  # ties are as stiff as the post


def test_a_bit_that_hangs_by_a_thread_is_left_out(monkeypatch):
    """A heavy bit on the corner of a cell, far softer than all else."""
    bit = lattice((0.2, 0, 0.9), (0.25, 0.05, 0.95), 0.05)
    structure = Structure(bound(post(extra=[bit], stiff=(slice(320, None), 1e-6))).bound)
    found, alone = structure.analyse(40), Structure(bound(post()).bound).analyse(40)
    # one point of 321 at its end, where four times the mean of its square moves: it is lower by half of 4 / 321
    assert found.first == pytest.approx(alone.first * 321 / 320, rel=0.03)
    assert found.square[0] >= LOOSE**2 * found.first
    monkeypatch.setattr(modal, "LOOSE", 0.0)
    monkeypatch.setattr(modal, "BITS", 0.0)
    every = structure.analyse(150)
    assert every.dropped == 0
    assert every.square[0] < LOOSE**2 * found.first


def test_a_bit_with_the_frequency_of_the_whole_takes_nothing_of_the_lean():
    """It shares the sway with the post in two modes of nearly the same frequency, and both are kept."""
    bit, leans = lattice((0.2, 0, 0.9), (0.25, 0.05, 0.95), 0.05), []
    for softer in (1.0, 1e-2, 1e-3, 4e-4):  # without the lower one it leans by 118 to 242 [m/N] instead
        points = post(extra=[bit], stiff=(slice(320, None), softer))
        found = Structure(bound(points).bound).analyse(40)
        shape = found.site_shape.reshape(-1, 3, len(found.square))[found.site]
        work = np.einsum("p,pam->am", (points.volume / points.volume.sum()).numpy(), shape)[:2] ** 2
        leans.append((work / found.square).sum(1))
    np.testing.assert_allclose(leans, leans[:1] * 4, rtol=0.02)


def test_a_rigid_part_has_six_degrees_of_freedom():
    head = RigidRegion(beyond(z=0.6))
    points = post()
    soft = Structure(bound(points).bound)
    structure = Structure(bound(points, boundaries=[PinnedRegion(FOOT), head]).bound)
    body = structure.total.rigid_bodies[0].mass.reshape(-1) > 0
    heavy = structure.mass > 1e-7 * structure.mass.max()
    gone = int((body.numpy() & heavy & (structure.pinned < 0)).sum())
    assert gone > 20
    assert structure.spread.shape[1] == soft.spread.shape[1] - 3 * gone + 6
    found = structure.analyse(20)
    shape = np.zeros((structure.nodes, 3, len(found.square)))
    shape[found.node] = found.shape.reshape(-1, 3, len(found.square))
    place = structure.total.node_positions(structure.total.node_mass).reshape(-1, 3).double().numpy()
    own = body.numpy().nonzero()[0]
    arm = place[own] - place[own].mean(0)
    for k in range(len(found.square)):
        moved = shape[own, :, k]
        rows = np.concatenate([np.concatenate([np.eye(3), -np.cross(np.eye(3), a).T], 1) for a in arm])
        fit, *_ = np.linalg.lstsq(rows, moved.ravel(), rcond=None)
        assert abs(rows @ fit - moved.ravel()).max() < 1e-9 * abs(moved).max()


@pytest.mark.parametrize(
    ("width", "most", "region", "words"),
    [
        # two points across one cell leave shapes of its nodes without any strain at a point
        (0.1, 10_000, FOOT, "most of this one hangs loose: hold more of it, give it more points"),
        (0.2, 10_000, Box([None] * 3, [None] * 3), r"`solver\.formulation: modes`"),
        (0.2, 100, FOOT, r"unknowns \(at most 100\): raise `solver.dx`, or set it to total"),
    ],
)
def test_what_has_no_modes_is_refused(width, most, region, words, monkeypatch):
    monkeypatch.setattr(modal, "MOST_UNKNOWNS", most)
    with value_error(words):
        Structure(bound(post(width=width), boundaries=[PinnedRegion(region)]).bound).analyse(10)


def test_a_batch_analyses_each_of_its_scenes():
    scenes = post(), post(E=1e5, stiff=(slice(40), 5))
    found = bound(MaterialPoints.stack(scenes), formulation="modes").bound
    alone = [bound(points, formulation="modes").bound.firsts for points in scenes]
    alike(found.firsts, torch.stack(alone), 1e-12)
