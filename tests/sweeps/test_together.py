"""Runs that are simulated together: as if each were alone, and done one by one where that fails."""

import json

import numpy as np
import pytest
import torch
from shared import rows

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.plan import parse_run, read_sweep
from gaussian_swaying.sweeps.run import Job, grouped, members_of

FIXED = {"solver.substep": 2e-3, "frames": 5}
OPTIONS = ("--workers", "2", "--device", "cpu")


def _motion(folder, name):
    with np.load(folder / "runs" / name / "trajectory.npz") as file:
        return {entry: file[entry] for entry in file.files}


def test_groups_depend_only_on_the_plan():
    runs = [{"material.E": k, "camera.init_args.width": 32 + k // 4} for k in range(6)]
    assert grouped(runs, 3) == [[0, 1, 2], [3], [4, 5]]
    assert grouped(runs, 1) == [[k] for k in range(6)]


def test_together_as_alone(tmp_path, sweep_file):
    """With a fixed substep the motion is that of each run alone, and so is everything in the table."""
    file = sweep_file(tmp_path / "tiny.yaml", settings=FIXED)
    alone, together = tmp_path / "alone", tmp_path / "together"
    assert main([str(file), "--output", str(alone), *OPTIONS]) == 0
    assert main([str(file), "--output", str(together), *OPTIONS, "--together", "5"]) == 0
    for one, other in zip(rows(alone / "sweep.csv"), rows(together / "sweep.csv"), strict=True):
        for name in one.keys() - {"largest_cfl"}:  # that of all
            try:
                assert float(other[name]) == pytest.approx(float(one[name]), rel=2e-4, abs=1e-7), name
            except ValueError:
                assert one[name] == other[name], name
        texts = [(folder / "runs" / one["run"] / "config.yaml").read_text() for folder in (alone, together)]
        assert texts[0] == texts[1]
        a, b = (_motion(folder, one["run"]) for folder in (alone, together))
        assert a.keys() == b.keys()
        for entry in a:
            np.testing.assert_allclose(b[entry], a[entry], atol=1e-6 if entry[0] == "p" else 2e-3)
        files = [sorted(p.name for p in (folder / "runs" / one["run"]).rglob("*.*")) for folder in (alone, together)]
        assert set(files[0]) - set(files[1]) == {"checkpoint.pt"}
        logs = [json.loads((f / "runs" / one["run"] / "summary.json").read_text()) for f in (alone, together)]
        for before, after in zip(logs[0]["per_frame"], logs[1]["per_frame"], strict=True):
            assert before.keys() == after.keys()
            for name, value in before.items():
                if not name.endswith("_particle") and name != "cfl":
                    assert after[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name


def test_the_state_of_a_scene(tmp_path, sweep_file):
    plan = read_sweep(sweep_file(tmp_path / "tiny.yaml", settings=FIXED))
    job = Job(tmp_path, tuple(plan.names), plan.config, plan.frames, tuple(plan.runs), "cpu")
    members = members_of(job)
    together = members[0].batch([member.model for member in members])
    state = together.start()
    assert state.position.shape[0] == 8
    frame = together.launch(state)
    end, _ = frame.finish()
    one = end.scene(3)
    assert torch.equal(one.position, end.position[3])
    assert one.F_total is one.F_elastic
    assert len(frame.each) == 8
    assert len({entry.wind_work for entry in frame.each}) == 8
    moved = torch.linalg.vector_norm(one.position - together.solver.points.position[3], dim=-1)
    assert frame.each[3].displacement_max == pytest.approx(float(moved.amax()))


def test_the_configurations_of_a_group_are_those_that_the_parser_writes(tmp_path, sweep_file):
    axes = {"wind.flow": [[3.0, 1.0, 0.0], [6, 1.5, -0.25]], "material.E": [3e3, 1e-2], "material.nu": [0.3, 0.0]}
    axes |= {"wind.seed": [1, 7], "material.density": [20, 30.5]}
    plan = read_sweep(sweep_file(tmp_path / "tiny.yaml", axes=axes, draws=1))
    runs, parser = (plan.runs[0], *plan.runs[6::6]), Simulation.parser()
    members = members_of(Job(tmp_path, ("",) * len(runs), plan.config, plan.frames, runs, "cpu"))
    settings = [parse_run(parser, plan.config, plan.frames, run) for run in runs]
    for one in settings:
        one.device = "cpu"
    expected = [config_text(parser, one) for one in settings]
    assert len(set(expected)) == 6
    assert [member.config for member in members] == expected


def test_a_diverged_run_is_done_alone(tmp_path, sweep_file, capsys):
    axes = {"wind.flow": [[4.0, 1.0, 0.0], [9e3, 0.0, 0.0], [5.0, 1.0, 0.0]]}
    file, folder = sweep_file(tmp_path / "bad.yaml", axes, 1, {"frames": 3}), tmp_path / "out"
    assert main([str(file), "--output", str(folder), *OPTIONS, "--together", "3"]) == 2
    assert [row["status"] for row in rows(folder / "sweep.csv")] == ["complete", "diverged", "complete"]
    assert "1 of 3 runs failed" in capsys.readouterr().err


def test_what_cannot_be_together_is_done_alone(tmp_path, sweep_file):
    settings = {"frames": 2, "edits": [{"time": 0.04, "E": 5e3}]}
    file, folder = sweep_file(tmp_path / "edits.yaml", {"wind.seed": [1, 2]}, 1, settings), tmp_path / "out"
    assert main([str(file), "--output", str(folder), *OPTIONS, "--together", "2"]) == 0
    assert "cannot be simulated as a batch" in (folder / "logs/00000.txt").read_text()


def test_a_killed_job_of_several_runs(tmp_path, sweep_file, kill):
    """The table is that of an undisturbed sweep, bit for bit, and another number of runs together is refused."""
    file = sweep_file(tmp_path / "tiny.yaml")
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert main([str(file), "--output", str(whole), *OPTIONS, "--together", "4"]) == 0
    kill(1)
    assert main([str(file), "--output", str(out), *OPTIONS, "--together", "4"]) == 0
    assert (out / "sweep.csv").read_bytes() == (whole / "sweep.csv").read_bytes()
    # one result is lost: its group is simulated again, and the others are left alone
    before = {path: path.stat().st_mtime_ns for path in (out / "results").glob("*.json")}
    (out / "results/00002.json").unlink()
    assert main([str(file), "--output", str(out), *OPTIONS, "--together", "4", "--resume"]) == 0
    changed = [path.name for path, time_ in before.items() if path.stat().st_mtime_ns != time_]
    assert changed == ["00002.json"]
    assert (out / "sweep.csv").read_bytes() == (whole / "sweep.csv").read_bytes()
    assert main([str(file), "--output", str(out), *OPTIONS, "--together", "3", "--resume"]) == 2
