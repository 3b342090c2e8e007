"""Variants of a simulation as a batch, against each on its own."""

import math
from types import SimpleNamespace

import pytest
import torch
from shared import in_both, longest, seeded, solid, unit, value_error
from small_films import base, changed

from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.inverse import variants
from gaussian_swaying.inverse.plan import Unknown
from gaussian_swaying.inverse.variants import states_of, turning
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation import step
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce
from gaussian_swaying.wind.patches import Patches

TIMES = [0.0, 1 / 24, 2 / 24, 4 / 24]


@pytest.mark.parametrize(("hertz", "told"), [(5.0, False), (10.0, True)])
def test_what_moves_too_fast_for_the_film_is_told(hertz, told, monkeypatch):
    """Another frequency goes beside it by t cos(2 pi f t), which turns from frame to frame at 10 Hz in 24 frames."""
    times = [k / 24 for k in range(25)]

    def moved(_, values, times):
        both = [(hertz * math.sqrt(own["material.E"] / 1e4), own["wind.speed"]) for own in values]
        ways = [[math.sin(2 * math.pi * rate * t) + 2 * speed * t for t in times] for rate, speed in both]
        return [[torch.tensor(way)[:, None, None].expand(-1, 1, 2)] for way in ways]

    monkeypatch.setattr(variants, "pixels_of", moved)
    sought = [Unknown("material.E", 1e3, 1e5, "log"), Unknown("wind.speed", 1.0, 9.0, "linear")]
    track = SimpleNamespace(seen=torch.ones(25, 1, dtype=torch.bool))
    found = turning([track], sought, torch.tensor([0.5, 0.5], dtype=torch.float64), times)
    assert [sentence.split()[0] for sentence in found] == ["material.E"] * told


def test_each_variant_moves_as_its_own_simulation(simulation, tmp_path):
    values = [
        {},
        {"wind.speed": 7.0, "wind.azimuth": 10.0},
        {"material.E": 5e3, "material.density": 40.0},
        {"aero.C_D": 0.4},
        {"solver.damping": 3.0},
    ]
    angle = torch.deg2rad(torch.tensor(10.0))
    changes = [
        {},
        {"wind": {"flow": [float(7 * angle.cos()), float(7 * angle.sin()), 0.0]}},
        {"material": {"E": 5e3, "density": 40.0}},
        {"aero": {"C_D": 0.4}},
        {"solver": {"damping": 3.0}},
    ]
    found = list(states_of(simulation, values, TIMES))
    still = found[0][0].position
    for number, settings in enumerate(changes):
        alone = list(states_of(changed(tmp_path, **settings), [{}], TIMES))
        moved = longest(alone[-1][0].position - still)
        off = longest(found[-1][number].position - alone[-1][0].position)
        assert moved > 0.05
        assert off < 6e-3 * moved  # the substeps differ, and the method is of first order in them
    assert [float(state.time) for state in found[-1]] == pytest.approx([TIMES[-1]] * len(values))


@in_both
def test_variants_of_a_scene_with_parts(formulation, tmp_path):
    """A pole that is held, cloth, and a rigid board at its end, as a batch and each on its own."""
    x = FlagScene(**base()["scene"]["generator"]["init_args"]).generate().means[:, 0].contiguous()
    labels = torch.bucketize(x, torch.tensor([0.06, 0.25]))
    roles = [Part("pole", "held"), Part("cloth"), Part("board", "rigid", density=60.0)]
    path = Parts(labels, roles).save(tmp_path / "parts.npz")

    def made(E):
        solver = {"boundaries": [], "formulation": formulation}
        return changed(tmp_path, scene={"parts": str(path)}, material={"E": E}, solver=solver)

    values = [{}, {"material.E": 3e3}]
    found = list(states_of(made(1e4), values, TIMES))
    still = found[0][0].position
    for own, state in zip((1e4, 3e3), found[-1], strict=True):
        (alone,) = list(states_of(made(own), [{}], TIMES))[-1]
        moved = longest(alone.position - still)
        assert moved > 0.01
        # the substeps differ; `updated` loses a little motion in each, with a board that is soft as well
        limit = 1e-2 if formulation == "total" else 6e-2
        assert longest(state.position - alone.position) < limit * moved
    with value_error(r"`material\.density` is to change, but .* `scene\.parts` or `scene\.materials` gives it too"):
        list(states_of(made(1e4), [{"material.density": 30.0}], TIMES))


def test_what_leaves_the_grid_of_updated_gets_a_larger_one(tmp_path, monkeypatch):
    """A free flag in a storm; its first grid knows nothing of the wind, and stopped it without a word."""
    solver = {"boundaries": [], "formulation": "updated"}
    simulation = changed(tmp_path, material={"E": 1e5}, wind={"flow": [40.0, 0.0, 0.0]}, solver=solver)
    times = [0.0, 0.05]
    (first,), (last,) = states_of(simulation, [{}], times)
    assert not last.lost.any()
    assert (last.position - first.position)[:, 0].mean() > 0.57
    monkeypatch.setattr(step, "MAX_RETRIES", 0)
    *_, (stopped,) = states_of(simulation, [{}], times, alike=False)
    assert stopped.lost.any()


def test_wind_on_patches_of_many_directions_in_a_batch():
    generator = seeded(0)
    normal = unit(40, 3, generator=generator, dtype=torch.float32)
    point = torch.randint(0, 6, (40,), generator=generator)
    area = torch.rand(40, generator=generator) * 0.01
    position = torch.rand(6, 3, generator=generator)
    aero = AeroForce(drag_step="semi_implicit")
    winds = [WindField([3.0, 1.0, 0.0]), WindField([-1.0, 0.5, 2.0])]

    def moved(wind, patches, shape):
        solver = MPMSolver(0.3)
        state = solver.init_state(solid(position.expand(*shape, 6, 3).contiguous(), 1e-3))
        return solver.rollout(state, 1e-3, 5, WindForce(aero, wind, patches))

    both = Patches(normal.repeat(2, 1), area.repeat(2), torch.cat([point, point + 6]), 12)
    batch = moved(winds, both, (2,))
    for place, wind in enumerate(winds):
        alone = moved(wind, Patches(normal, area, point, 6), ())
        one = batch.scene(place)
        torch.testing.assert_close(one.position, alone.position)
        torch.testing.assert_close(one.work, alone.work)
        assert one.node_velocity.shape == alone.node_velocity.shape


VALUES = [{}, {"wind.speed": 7.0}, {"material.E": 5e3}, {"aero.C_D": 0.4}]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_batch_in_the_kernels_moves_as_in_torch(own):
    times = [0.0, 1 / 24, 4 / 24]
    found = {}
    for device in ("cpu", "cuda"):
        found[device] = list(states_of(Simulation.from_yaml(own / "base.yaml", device=device), VALUES, times))[-1]
    for slow, fast in zip(found["cpu"], found["cuda"], strict=True):
        moved = float(longest(slow.position.sub(fast.position.cpu())))
        assert moved < 1e-3
