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


@pytest.mark.parametrize(("cores", "seconds"), [(1, 1 + 4), (2, 1 + 4), (5, 1 + 4 / 4), (9, 1 + 4 / 8)])
def test_files_are_written_beside_the_simulation_where_there_are_cores(cores, seconds, monkeypatch, make_simulation):
    """A picture of 1 s, and 4 s for its files, which further threads write; of a place ten times as large, 10 s."""
    simulation = make_simulation()
    whole = simulation.scene.model.to_cloud().select(torch.arange(960) % 96)
    monkeypatch.setattr(cost_module, "WORKERS", 8)
    monkeypatch.setattr(cost_module, "cores", lambda: cores)
    for cloud, more in ((None, 0), (whole, 9)):
        clock = iter([1.0, 1.0, 4.0, 4.0])
        monkeypatch.setattr(cost_module, "_seconds", lambda simulation, work, clock=clock: next(clock))
        assert cost_module._picture_seconds(simulation, simulation.start(), cloud) == seconds + more


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
