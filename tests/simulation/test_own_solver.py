"""A solver that the package does not know: through the simulation, the recorder, the live page and ``eval``."""

import json

import pytest
import torch
import yaml
from own_springs import Springs, flag
from shared import near, peak, refused, up_to

from gaussian_swaying import AeroForce, PinnedRegion, Simulation
from gaussian_swaying.cli.evaluate import main as evaluate
from gaussian_swaying.cli.simulate import main
from gaussian_swaying.geometry.regions import Sphere
from gaussian_swaying.mpm.embedded import EmbeddedAtPoints
from gaussian_swaying.player.session import Session
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.model import Edit

BOX = {"min": [None, None, None], "max": [0.11, None, None]}


@pytest.fixture
def simulation():
    return flag(Springs(boundaries=[PinnedRegion(up_to(x=0.06))]))


def test_a_run_is_resumed_bit_for_bit(simulation, tmp_path):
    simulation.run(tmp_path / "whole", 6, progress=False)
    simulation.run(tmp_path / "parts", 3, progress=False)
    simulation.run(tmp_path / "parts", 6, resume=True, progress=False)
    for k in (2, 5):
        whole, parts = (load_trajectory(tmp_path / name / "trajectory.npz", k) for name in ("whole", "parts"))
        assert torch.equal(whole[0], parts[0])
        assert torch.equal(whole[1], parts[1])
    summary = json.loads((tmp_path / "parts" / "summary.json").read_text())
    assert (summary["status"], summary["formulation"]) == ("complete", "springs")
    assert "grid" not in summary
    assert evaluate([str(tmp_path / "parts"), str(tmp_path / "whole"), "--no-video", "--device", "cpu"]) == 0


def test_energy_is_kept_and_pins_hold(simulation):
    """Without wind and damping, what falls turns into motion and stretch, to the order of the substep."""
    simulation.wind = None
    simulation.aero = AeroForce(air_density=0.0)
    frames = list(simulation.frames(10))
    first, last = frames[0].health, frames[-1].health
    total = [health.kinetic + health.elastic + health.potential for health in (first, last)]
    assert last.kinetic > 0.01
    assert abs(total[1] - total[0]) < 0.02 * last.kinetic
    held = ~simulation.solver.free
    assert torch.equal(frames[-1].state.position[held], frames[0].state.position[held])
    assert isinstance(simulation.scene.follow, EmbeddedAtPoints)


def test_edits_and_parameters_reach_it(simulation):
    state = simulation.start()
    soft = simulation.edit(state, Edit(region=Sphere([1.0, 0.0, 0.5], 0.3), E=1e3))
    assert simulation.solver.stiffness.amin() < 1e-1 * simulation.solver.stiffness.amax()
    state = simulation.start()
    simulation.change({"wind.speed": 5.0, "solver.damping": 4.0})
    assert simulation.solver.settings.damping == 4.0
    assert float(simulation.wind.flows[0].norm()) == pytest.approx(5.0)
    _, health = simulation.advance(state)
    assert health.kinetic > 0
    assert soft.position.shape == state.position.shape


def test_a_batch_moves_as_each_alone(simulation):
    variant = simulation.variant({"wind.speed": 6.0})
    batch = simulation.batch([simulation.model, variant.model])
    state = batch.start()
    ends = [(member, member.start()) for member in (simulation, variant)]
    for _ in range(2):
        steps = batch.substeps(state)
        frame = batch.launch(state, steps)
        state, _ = frame.finish()
        ends = [(member, member.stepper.launch(end, steps).finish()[0]) for member, end in ends]
    for k, (member, end) in enumerate(ends):
        near(state.scene(k).position, end.position, 1e-6)
        assert frame.each[k].kinetic == pytest.approx(float(member.solver.energies(end)["kinetic"]), rel=1e-4)


JET = """
import torch
from gaussian_swaying import SpatialWind


class Jet(SpatialWind):
    def __init__(self, speed: float = 3.0) -> None:
        super().__init__()
        self.speed = speed

    def forward(self, time, position):
        zero = torch.zeros_like(position[..., 2])
        return torch.stack([zero, self.speed * torch.exp(-(position[..., 2] ** 2)), zero], dim=-1)
"""


def test_a_yaml_names_a_solver_and_a_wind(tmp_path, monkeypatch, capsys):
    """With its class path; the configuration of the run has both, and either excludes the usual group."""
    (tmp_path / "my_jet.py").write_text(JET)
    monkeypatch.syspath_prepend(tmp_path)
    pins = [{"class_path": "PinnedRegion", "init_args": {"region": {"class_path": "Box", "init_args": BOX}}}]
    config = {
        "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1}}},
        "custom_wind": {"class_path": "my_jet.Jet", "init_args": {"speed": 5.0}},
        "custom_solver": {
            "class_path": "own_springs.Springs",
            "init_args": {"dx": 0.2, "gravity": [0.0, 0.0, 0.0], "boundaries": pins},
        },
        "recorder": {"renders": []},
    }
    file, folder = tmp_path / "scene.yaml", tmp_path / "run"
    file.write_text(yaml.safe_dump(config))
    options = ["--config", str(file), "--frames", "3", "--device", "cpu"]
    assert main([*options, "--output", str(folder)]) == 0
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["formulation"], summary["frames"]) == ("springs", 3)
    assert summary["wind_work_J"] > 0
    kept = yaml.safe_load((folder / "config.yaml").read_text())
    assert kept["custom_wind"]["init_args"] == {"speed": 5.0}
    assert kept["custom_solver"]["init_args"]["dx"] == 0.2
    words = "`custom_wind` replaces `wind`: leave out one of them."
    more = ["--output", str(tmp_path / "other"), "--wind.flow", "[1, 0, 0]"]
    refused(main, [*options, *more], capsys, words, folder=tmp_path)


def test_the_live_page_moves_it(simulation, tmp_path):
    settings = {"scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.05}}}, "device": "cpu"}
    settings["wind"] = {"flow": [1.0, 2.5, 0.0]}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(settings))
    parser = Simulation.parser()
    session = Session(parser, parser.parse_args(["--config", str(tmp_path / "scene.yaml")]), simulation)
    session._advance(single=True)
    session._change({"wind.flow": [0.0, 6.0, 0.0]})
    assert session.simulation is simulation
    assert float(simulation.wind.flows[0][1]) == 6.0
    session._grab([1.1, 0.0, 0.4])
    before = session.snapshot.state.position.clone()
    session._advance(single=True)
    assert session.problem is None
    assert peak(session.snapshot.state.position - before) > 0
