"""Runs that are simulated together on a GPU, and sweeps on one and several GPUs."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import advanced, peak, rows

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.sweeps.plan import read_sweep
from gaussian_swaying.sweeps.run import Job, members_of

pytestmark = pytest.mark.gpu


def _batch(tmp_path, file):
    plan = read_sweep(file)
    job = Job(tmp_path, tuple(plan.names), plan.config, plan.frames, tuple(plan.runs), "cuda")
    members = members_of(job)
    return members[0].batch([member.model for member in members]), members


def test_together_is_as_alone(tmp_path, sweep_file):
    settings = {"solver.substep": 2e-3, "frames": 5}
    together, members = _batch(tmp_path, sweep_file(tmp_path / "tiny.yaml", settings=settings))
    state = together.start()
    assert together.solver.kernels is not None
    for _ in range(4):
        frame = together.launch(state)
        state, _ = frame.finish()
    for number, member in enumerate(members):
        alone, log = advanced(member, 4)
        own = log[-1]
        moved = float(peak(alone.position - member.solver.points.position))
        assert peak(state.scene(number).position - alone.position) < 1e-4 * moved
        shared = frame.each[number]
        assert shared.substeps == own.substeps
        assert shared.wind_work == pytest.approx(own.wind_work, rel=1e-3, abs=1e-6)
        assert np.allclose(shared.support, own.support, rtol=1e-3, atol=1e-5)


def test_together_foresees(tmp_path, sweep_file):
    together, _ = _batch(tmp_path, sweep_file(tmp_path / "tiny.yaml"))
    state, _ = together.advance(together.start())
    assert together.foresees
    assert together.outlook is not None
    expected = together.substeps(state)
    assert together.advance(state)[1].substeps == expected


@pytest.mark.timeout(600)
def test_a_sweep_on_all_gpus(tmp_path, sweep_file):
    """Tables of two sweeps are equal bit for bit if sums have a fixed order."""
    settings = {"solver.deterministic": True, "recorder.video": False}
    file, folder = sweep_file(tmp_path / "tiny.yaml", settings=settings), tmp_path / "out"
    assert main([str(file), "--output", str(folder), "--together", "4", "--device", "cuda"]) == 0
    assert {row["status"] for row in rows(folder / "sweep.csv")} == {"complete"}
    for result in (folder / "results").iterdir():
        assert json.loads(result.read_text())["peak_memory_bytes"]["device"] > 0
    again = tmp_path / "again"
    assert main([str(file), "--output", str(again), "--together", "4", "--device", "cuda", "--workers", "2"]) == 0
    assert (again / "sweep.csv").read_bytes() == (folder / "sweep.csv").read_bytes()


@pytest.mark.timeout(600)
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_training_on_two_gpus(tmp_path):
    tool = Path(__file__).parents[2] / "tools/train.py"
    command = [sys.executable, str(tool), "fit", "--config", "quick_cpu", "--trainer.accelerator", "gpu"]
    command += ["--trainer.devices", "2", "--trainer.default_root_dir", str(tmp_path / "two")]
    command += ["--data.init_args.path", str(tmp_path / "capture")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(list((tmp_path / "two").rglob("*.ply"))) == 1
    log = [row for row in rows(tmp_path / "two/csv/metrics.csv") if row.get("val/psnr")]
    assert float(log[-1]["val/psnr"]) > 18
