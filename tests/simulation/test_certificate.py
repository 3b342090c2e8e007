import json

import pytest
import torch
from shared import peak, up_to, value_error

from gaussian_swaying import AeroForce, Copy, Material, MPMSolver, PinnedRegion, Recorder, Simulation
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.certificate import APART, COARSER, MODEL, SAFETY, error_of
from gaussian_swaying.simulation.measure import SimulationDiverged

DT = 0.1
TIME = DT * torch.arange(20, dtype=torch.float64)


def _swing(points=3):
    direction = torch.tensor([[1.0, 0, 0], [0, 2.0, 0], [0, 0, -1.0]], dtype=torch.float64)[:points]
    return torch.sin(4 * TIME)[:, None, None] * direction


def test_the_error_of_a_method_of_known_order():
    """Second order in the cell and first in the substep, so its error is known exactly."""
    swing, by_grid, by_step = _swing(), 0.01, 0.3
    substeps = [2000, 1000, 800]

    def solved(cell, count):
        return swing * (1 + by_grid * cell**2 + by_step / count)

    found = error_of([solved(1.0, 2000), solved(COARSER, 1000), solved(COARSER, 800)], substeps, DT)
    size = swing.square().sum(-1).mean(-1).sqrt()
    grid = by_grid * (COARSER**2 - 1) + by_step / 2000
    assert found["grid_m"] == pytest.approx((SAFETY * grid / (COARSER**2 - 1) * size).tolist())
    assert found["substep_m"] == pytest.approx((SAFETY * by_step / 2000 * size).tolist())
    assert found["model_m"] == pytest.approx([MODEL * moved for moved in found["motion_m"]])
    parts = torch.tensor([found["grid_m"], found["substep_m"], found["model_m"]], dtype=torch.float64)
    assert found["error_m"] == pytest.approx(parts.norm(dim=0).tolist())
    true = (solved(1.0, 2000) - swing).square().sum(-1).mean(-1).sqrt()
    assert (torch.tensor(found["error_m"], dtype=torch.float64) >= true).all()
    assert found["trusted_s"] == pytest.approx(1.9)
    assert found["chaos_s"] is None
    assert "statistics" not in found["sentence"]


def test_two_runs_that_part_are_chaos_and_a_coarser_grid_that_parts_is_not():
    run = _swing()
    size = float((run - run.mean(0)).square().sum(-1).mean(-1).mean().sqrt())
    away = torch.where(TIME >= 0.95, 2 * APART * size, 0.0)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    chaos = error_of([run, run, run + away], [9, 6, 5], DT)
    assert (chaos["trusted_s"], chaos["chaos_s"]) == (pytest.approx(0.9), pytest.approx(1.0))
    assert "statistics" in chaos["sentence"]
    grid = error_of([run, run + away, run + away], [9, 6, 5], DT)
    assert (grid["trusted_s"], grid["chaos_s"]) == (pytest.approx(0.9), None)
    assert "`solver.dx`" in grid["sentence"]


def _solver(dx=0.1, damping=0.5):
    return MPMSolver(dx=dx, damping=damping, boundaries=[PinnedRegion(up_to(x=0.11))])


def _flag(**changes):
    given = {"solver": _solver(), "material": Material(E=3e4, density=30.0), "wind": [2.0, 0.3, 0.0], "device": "cpu"}
    quiet = Recorder(trajectory=False, nodes=False, checkpoint_every=0, renders=())
    return Simulation(FlagScene(spacing=0.05), **(given | {"recorder": quiet} | changes))


def test_a_run_with_a_certificate(tmp_path):
    frames = 12
    summary = _flag().run(tmp_path / "run", frames, progress=False, certify=True)
    found = summary["certificate"]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["certificate"] == found
    assert found["dx_m"] == pytest.approx([0.1, 0.15])
    assert found["substeps"][0] == summary["substeps"] > found["substeps"][1] > found["substeps"][2]
    assert found["left"] == []
    assert (tmp_path / "run" / "certificate.svg").read_text().startswith("<svg")
    plain = _flag()
    motion = [(frame.gaussians.means - plain.scene.model.means).double() for frame in plain.frames(frames)]
    expected = [float(moved.square().sum(-1).mean().sqrt()) for moved in motion]
    assert found["motion_m"] == pytest.approx(expected, rel=1e-5)
    assert 0 < found["error_m"][3] < found["error_m"][-1] < peak(torch.tensor(expected))


def test_balances(tmp_path, monkeypatch):
    falling = _flag(solver=_solver(damping=0.0), wind=None, aero=AeroForce(C_D=0.0, C_F=0.0, C_L=0.0))
    still = falling.run(tmp_path / "still", 12, progress=False, certify=True)["certificate"]
    substeps, still = still["substeps"][0], still["balances"]
    assert still["mass_lost"] == 0
    # both are of first order in the substep, of which a velocity is half a one away from its place
    assert still["energy_gained"] < 1 / substeps
    assert still["momentum_unexplained"] < 1 / substeps
    monkeypatch.setattr("gaussian_swaying.simulation.certificate._push", lambda *_: torch.zeros(3))
    unknown = _flag().run(tmp_path / "wind", 12, progress=False, certify=True)["certificate"]["balances"]
    assert unknown["momentum_unexplained"] > 0.1


def test_other_runs_are_those_of_other_simulations(tmp_path):
    """The distance to the coarser grid is that of a simulation that was made on it."""
    found = _flag().run(tmp_path / "run", 6, progress=False, certify=True)["certificate"]
    fine, coarse = _flag(), _flag(solver=_solver(0.15))
    pair = zip(fine.frames(6), coarse.frames(6), strict=True)
    apart = [float((a.gaussians.means - b.gaussians.means).square().sum(-1).mean().sqrt()) for a, b in pair]
    assert found["grid_m"] == pytest.approx([SAFETY * d / (COARSER**2 - 1) for d in apart], rel=1e-4, abs=1e-9)


def test_a_coarser_run_that_fails_leaves_the_run(tmp_path, monkeypatch):
    simulation = _flag()

    def failing(*_):
        raise SimulationDiverged(0.1, 3, "too coarse", "a finer grid")

    monkeypatch.setattr("gaussian_swaying.simulation.certificate._motion", failing)
    summary = simulation.run(tmp_path / "run", 3, progress=False, certify=True)
    assert summary["status"] == "complete"
    assert "too coarse" in summary["certificate"]["sentence"]
    assert not (tmp_path / "run" / "certificate.svg").exists()


def test_what_cannot_be_certified_is_refused_before_the_run(tmp_path):
    changed = _flag()
    changed.change("wind.speed", 3.0)
    cases = {
        "`wind` changed": (changed, {}),
        "A variant cannot": (_flag().variant({"wind.speed": 3.0}), {}),
        "leave out `resume`": (_flag(), {"resume": True}),
        "leave out `copies`": (_flag(copies=[Copy([0.0, 2.0, 0.0])]), {}),
    }
    for told, (simulation, options) in cases.items():
        with value_error(told):
            simulation.run(tmp_path / "run", 3, progress=False, certify=True, **options)
    assert not (tmp_path / "run").exists()


def test_strain_and_speed_beyond_the_rules_are_named(tmp_path):
    soft = _flag(material=Material(E=3e3, density=30.0))
    left = soft.run(tmp_path / "run", 12, progress=False, certify=True)["certificate"]["left"]
    assert [sentence.split()[0] for sentence in left] == ["strain"]
