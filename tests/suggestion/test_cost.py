from types import SimpleNamespace

import pytest
import torch
from shared import up_to

from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion import cost as cost_module
from gaussian_swaying.suggestion.cost import estimate_cost


def test_a_trial_is_long_enough_to_time_substeps(monkeypatch, make_simulation):
    """Whatever a rollout takes besides: here as much as 100 substeps. And it is no longer than a frame."""
    simulation = make_simulation()
    state, asked = simulation.start(), []
    monkeypatch.setattr(MPMSolver, "watched_rollout", lambda self, state, dt, steps, forces, looks: asked.append(steps))
    monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work: work() or 1e-5 * (100 + asked[-1]))
    assert cost_module._substep_seconds(simulation, state, 10_000) < 2e-5
    assert max(asked) == 4096
    assert cost_module._substep_seconds(simulation, state, 30) == pytest.approx(130e-5 / 30)
    assert asked[-1] == 30


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled")
def test_compiling_is_not_counted(monkeypatch):
    now = [10.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 0.5 * now[0])
    monkeypatch.setattr(cost_module, "time", clock)
    watch, device = cost_module.Stopwatch(), SimpleNamespace(type="cpu")
    now[0] += 0.2
    assert (watch.wall, watch.on(device)) == (pytest.approx(0.2), pytest.approx(0.1))
    count, wall, busy = cpu.compiled()
    monkeypatch.setattr(cpu, "_spent", [count + 1, wall + 0.15, busy + 0.08])
    assert (watch.wall, watch.on(device)) == (pytest.approx(0.05), pytest.approx(0.02))


@pytest.mark.parametrize(("cores", "seconds"), [(2, 1 + 4), (4, 4 / 2 - 0.5), (9, 1.0)])
def test_files_are_written_beside_the_simulation_where_there_are_cores(cores, seconds, monkeypatch, make_simulation):
    """A picture of 1 s, and 4 s for its files: further threads write them, and a frame takes 0.5 s without it."""
    simulation, clock = make_simulation(), iter([1.0, 1.0, 4.0, 4.0])
    monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work: next(clock))
    monkeypatch.setattr(cost_module, "WORKERS", 2 if cores == 4 else 8)
    monkeypatch.setattr(cost_module, "cores", lambda: cores)
    assert cost_module._picture_seconds(simulation, simulation.start(), 0.5, None) == seconds


def test_a_place_adds_what_its_other_gaussians_take(monkeypatch, make_simulation):
    """Here 1 ms to draw each, besides 3 ms, and 0.5 s for all that the simulation has; and nothing to write a file."""
    simulation = make_simulation()
    whole = simulation.scene.model.to_cloud().select(torch.arange(960) % 96)
    clock = iter([0.5, 0.5, 0.0, 0.0])
    monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work: next(clock))
    monkeypatch.setattr(cost_module, "_drawn", lambda simulation, cloud: 3e-3 + 1e-3 * len(cloud))
    found = cost_module._picture_seconds(simulation, simulation.start(), 1e9, whole)
    assert found == pytest.approx(0.5 + 1e-3 * (960 - 96))


@pytest.mark.parametrize("frames", [1, 2, 101])
def test_a_run_takes_as_many_substeps_as_it_has_frames_after_the_first(frames, monkeypatch, make_simulation):
    simulation, at_rest = make_simulation(), 10
    taken, each = iter([11, 12, 16]), iter([0.0, 1e-3 * 11, 9e-3 * 12, 2e-3 * 16])
    monkeypatch.setattr(cost_module, "MOST_FRAMES", 3)
    monkeypatch.setattr(cost_module, "_substep_seconds", lambda *given: 0.0)
    monkeypatch.setattr(cost_module, "_picture_seconds", lambda *given: 0.25)
    monkeypatch.setattr(MPMSolver, "substeps", lambda self, state, dt: at_rest)
    monkeypatch.setattr(Simulation, "advance", lambda self, state: (state, SimpleNamespace(substeps=next(taken))))
    monkeypatch.setattr(cost_module.Stopwatch, "on", lambda self, device: next(each))
    next(each)
    found = estimate_cost(simulation, frames, startup_seconds=3.0, budget=1e9)
    assert (found.substep_seconds, found.substeps) == (pytest.approx(2e-3), 13)
    simulated = (frames - 1) * 13 * 2e-3
    assert found.simulation_seconds == pytest.approx(simulated)
    assert found.total_seconds == pytest.approx(3.0 + simulated + 0.25 * frames)


def test_a_cost_is_that_of_its_run(make_simulation):
    simulation = make_simulation()
    cost = estimate_cost(simulation, frames=11)
    assert cost.substeps >= simulation.solver.substeps(simulation.start(), 0.04) > 1
    assert cost.particles == 96
    assert cost.total_seconds > cost.simulation_seconds > 0
    simulation.recorder = Recorder(renders=())
    assert estimate_cost(simulation, 2).picture_seconds is None


@pytest.mark.gpu
def test_kernels_are_loaded_before_a_gpu_is_timed():
    pole = PinnedRegion(up_to(x=0.06))
    solver = MPMSolver(0.05, boundaries=[pole], damping=0.2)
    for _ in range(2):
        simulation = Simulation(FlagScene(spacing=0.02), solver=solver, wind=[5.0, 1.0, 0.0], device="cuda")
        assert 0 < estimate_cost(simulation, 250).startup_seconds <= cost_module.WARM_UP
