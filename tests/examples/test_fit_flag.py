"""The example that finds wind and stiffness from a motion."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "examples/fit_flag.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("fit_flag", TOOL)
    module = sys.modules["fit_flag"] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["fit_flag"]


def test_a_few_iterations_lead_towards_the_truth(tool):
    """A coarse flag and 0.2 s: the loss falls a hundredfold, and both errors to less than a third."""
    setup = tool.Setup(spacing=0.05, frames=10)
    observed = tool.record(setup, seed=1)
    assert observed.shape == (10, 96, 3)
    reports = []
    result = tool.fit(setup, observed, iterations=6, report=lambda *row: reports.append(row))
    before = tool.Fit(tool.GUESS, [], 0.0).errors()
    assert before[0] > 0.4
    assert before[1] > 0.6
    assert min(result.losses) < result.losses[0] / 100
    for start, end in zip(before, result.errors(), strict=True):
        assert end < start / 3
    assert [row[0] for row in reports] == list(range(1, len(result.losses) + 1))
    assert reports[0][2] == pytest.approx(tool.GUESS)


def test_noise_is_seeded_and_as_large_as_asked(tool):
    setup = tool.Setup(spacing=0.1, frames=2)
    plain, a, b, c = (tool.record(setup, noise=n, seed=s) for n, s in ((0.0, 0), (1e-3, 0), (1e-3, 0), (1e-3, 1)))
    assert (a == b).all()
    assert not (a == c).all()
    assert float((a - plain).std()) == pytest.approx(1e-3, rel=0.2)


def test_a_fit_that_stops_early_says_so(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tool.Setup, "__init__", _coarse(tool.Setup.__init__))
    assert tool.main(["--frames", "2", "--iterations", "1", "--json", str(tmp_path / "fit.json")]) == 1
    recorded = json.loads((tmp_path / "fit.json").read_text())
    assert recorded["within_tolerance"] is False
    assert max(recorded["relative_errors"]) > tool.TOLERANCE
    assert "Young's modulus" in capsys.readouterr().out


def _coarse(init):
    return lambda self, **given: init(self, **({"spacing": 0.1} | given))


@pytest.mark.slow
def test_both_are_found_within_two_per_cent(tool, tmp_path):
    assert tool.main(["--json", str(tmp_path / "fit.json")]) == 0
    recorded = json.loads((tmp_path / "fit.json").read_text())
    assert max(recorded["relative_errors"]) < 0.02
    assert recorded["seconds"] < 300
    assert recorded["losses"][-1] < 1.2 * 3 * (recorded["noise"] / tool.MILLIMETRE) ** 2  # down to the noise
