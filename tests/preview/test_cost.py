"""The estimate of a run's time: from one grid to another, the grid for a time, and against runs."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from small_scenes import run_cost

from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.preview import cost as cost_module
from gaussian_swaying.preview.cost import estimate_cost, finest_within, scaled_seconds, with_whole
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material
from gaussian_swaying.simulation.simulation import Simulation

FRAMES = 101


def cost(dx, power=2.0, picture=0.1):
    """A substep of 1 ms at dx = 0.04 that takes longer with a power of 1 / dx; 100 of them in a frame there."""
    substep, steps = 1e-3 * (0.04 / dx) ** power, round(100 * 0.04 / dx)
    seconds = {"substep_seconds": substep, "simulation_seconds": substep * steps * (FRAMES - 1)}
    return run_cost(dx, frames=FRAMES, substeps=steps, picture_seconds=picture, startup_seconds=5.0, **seconds)


def test_a_trial_is_long_enough_to_time_substeps(monkeypatch, make_simulation):
    """Whatever a rollout takes besides: here as much as 100 substeps. And it is no longer than a frame."""
    simulation = make_simulation()
    state, asked = simulation.start(), []
    monkeypatch.setattr(MPMSolver, "watched_rollout", lambda self, state, dt, steps, forces, looks: asked.append(steps))
    monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work: work() or 1e-5 * (100 + asked[-1]))
    _, found = cost_module._trial(simulation, state, 10_000)
    assert found < 2e-5
    assert max(asked) == 4096
    assert cost_module._trial(simulation, state, 30)[1] == pytest.approx(130e-5 / 30)
    assert asked[-1] == 30


@pytest.mark.parametrize("times", [10, 2])
def test_a_place_adds_what_its_other_gaussians_take(times, monkeypatch, make_simulation):
    """In proportion to their number: here 1 ms to draw each, and 0.1 ms to copy it. Half of all may move, too."""
    simulation = make_simulation()
    some = simulation.scene.model.to_cloud()
    whole = some.select(torch.arange(times * len(some)) % len(some))
    drawn = []
    simulation.painter.renderer = lambda means, *given: drawn.append(len(means))

    def seconds(simulation, work):
        drawn.clear()
        work()
        return 1e-3 * drawn[0] if drawn else 1e-4 * len(range(0, len(whole), 5))

    monkeypatch.setattr(cost_module, "_seconds", seconds)
    found = with_whole(cost(0.04), simulation, whole)
    assert found.picture_seconds == pytest.approx(0.1 + 1.1e-3 * (times - 1) * len(some))
    assert found == dataclasses.replace(cost(0.04), picture_seconds=found.picture_seconds)
    assert with_whole(cost(0.04, picture=None), simulation, whole).picture_seconds is None


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled")
def test_compiling_is_not_counted(monkeypatch):
    """It is done once on a machine, and another run finds the kernels."""
    now = [10.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 0.5 * now[0])
    monkeypatch.setattr(cost_module, "time", clock)
    watch = cost_module.Stopwatch()
    now[0] += 0.2
    assert (watch.wall, watch.quiet) == (pytest.approx(0.2), pytest.approx(0.1))
    count, wall, busy = cpu.compiled()
    monkeypatch.setattr(cpu, "_spent", [count + 1, wall + 0.15, busy + 0.08])
    assert (watch.wall, watch.quiet) == (pytest.approx(0.05), pytest.approx(0.02))


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0, 3.0])
def test_another_grid_has_other_substeps_and_the_same_pictures(power):
    here = cost(0.04, power)
    assert here.total_seconds == pytest.approx(5 + 10 + 10.1)
    fine = scaled_seconds(here, cost(0.06, power, picture=0.01), 0.02)
    assert fine == pytest.approx(5 + 10 * 2 ** (1 + power) + 10.1, rel=0.02)
    assert scaled_seconds(here, here, 0.04) == pytest.approx(here.total_seconds)


def test_without_two_grids_a_surface_is_assumed():
    here = cost(0.04, 1.0)
    assert scaled_seconds(here, here, 0.02) == pytest.approx(5 + 10 * 2**3 + 10.1)


@pytest.mark.parametrize("power", [0.0, 1.3, 3.0])
@pytest.mark.parametrize("seconds", [22.0, 40.0, 300.0])
def test_the_finest_grid_for_a_time_is_found(power, seconds):
    tried = []

    def measure(dx):
        tried.append(dx)
        return cost(dx, power)

    found = finest_within(measure, seconds, cost(0.04, power), 0.01, 0.06)
    assert found.total_seconds <= seconds
    assert len(tried) <= 3
    assert found.dx == 0.01 or cost(found.dx - 0.0021, power).total_seconds > seconds
    assert all(0.01 <= dx <= 0.06 and dx == float(f"{dx:.2g}") for dx in tried)


def test_the_coarsest_grid_is_the_answer_if_none_is_fast_enough():
    assert finest_within(cost, 3.0, cost(0.04), 0.01, 0.06).dx == 0.06


def test_a_grid_that_is_too_fine_to_start_is_passed_over():
    def measure(dx):
        if dx < 0.018:
            raise ValueError("too many nodes")
        return cost(dx)

    assert 0.018 <= finest_within(measure, 1e6, cost(0.04), 0.01, 0.06).dx < 0.04
    with pytest.raises(ValueError, match="too many nodes"):
        finest_within(measure, 1e-6, cost(0.012), 0.01, 0.015)


def test_files_are_written_beside_the_simulation_where_there_are_cores(monkeypatch):
    """A picture of 1 s, and 4 s for its files: two more threads write them, and a frame takes 0.5 s without it."""
    simulation, clock = flag("cpu"), iter([1.0, 1.0, 4.0, 4.0] * 2)
    state = simulation.start()
    monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work: next(clock))
    monkeypatch.setattr(cost_module, "WORKERS", 2)
    found = {}
    for cores in (2, 4):
        monkeypatch.setattr(cost_module, "cores", lambda cores=cores: cores)
        found[cores] = cost_module._picture_seconds(simulation, state, 0.5)
    assert found == {2: 1 + 4, 4: 4 / 2 - 0.5}


@pytest.mark.parametrize("frames", [1, 2, 101])
def test_a_run_takes_as_many_substeps_as_it_has_frames_after_the_first(frames, monkeypatch):
    """Of timed frames the median time of a substep, and the mean number of them."""
    monkeypatch.setattr(cost_module, "_timed_frames", lambda *_: (0.5, [1e-3, 9e-3, 2e-3], [5001, 5002, 5007]))
    monkeypatch.setattr(cost_module, "_picture_seconds", lambda *_: 0.25)
    found = estimate_cost(flag("cpu"), frames, startup_seconds=3.0)
    assert (found.substep_seconds, found.substeps, found.startup_seconds) == (2e-3, 5003, 3.5)
    simulated = {1: 0.0, 2: 5003 * 2e-3, 101: 100 * 5003 * 2e-3}[frames]
    assert found.simulation_seconds == pytest.approx(simulated, rel=1e-12)
    assert found.total_seconds == pytest.approx(3.5 + simulated + 0.25 * frames)


def test_cost_is_the_product_of_its_parts(make_simulation):
    simulation = make_simulation(frame_dt=0.04)
    cost = estimate_cost(simulation, frames=11)
    # E = 3e3, nu = 0.3, 30 kg/m^3 by default of the fixture; c^2 = (lambda + 2 mu) / rho
    speed = math.sqrt(3e3 * 0.7 / (1.3 * 0.4) / 30)
    assert cost.wave_speed == pytest.approx(speed, rel=1e-5)
    assert cost.substeps >= math.ceil(0.04 / (0.4 * 0.2 / speed) - 1e-6)
    assert cost.substep == pytest.approx(0.04 / simulation.solver.substeps(simulation.start(), 0.04))
    assert cost.substep <= cost.stable_substep
    assert cost.particles == 96
    assert cost.simulation_seconds == pytest.approx(10 * cost.substeps * cost.substep_seconds)
    assert cost.total_seconds == pytest.approx(cost.simulation_seconds + 11 * cost.picture_seconds)
    simulation.recorder = Recorder(images=False, video=False)
    assert estimate_cost(simulation, 2).picture_seconds is None


def flag(device):
    """A flag in code."""
    pole = PinnedRegion(Box([None] * 3, [0.06, None, None]))
    return Simulation(
        FlagScene(spacing=0.02),
        Material(E=6e3, density=30.0, thickness=0.01),
        solver=MPMSolver(dx=0.05, boundaries=[pole], damping=0.2),
        wind=[5.0, 1.0, 0.0],
        device=device,
    )


@pytest.mark.gpu
def test_kernels_are_loaded_before_a_gpu_is_timed():
    """They are a part of the start, and not of a frame."""
    first, second = (estimate_cost(flag("cuda"), 250) for _ in range(2))
    assert 0 < first.startup_seconds <= cost_module.WARM_UP
    assert 0 < second.startup_seconds <= cost_module.WARM_UP
    assert first.substeps == second.substeps
