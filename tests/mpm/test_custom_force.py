"""A custom force, from outside the package: examples/custom_force.py, with a twin for the kernels."""

import importlib
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]


@pytest.fixture
def module(monkeypatch):
    """The example."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    yield importlib.import_module("custom_force")
    sys.modules.pop("custom_force", None)


def test_the_example_ends_in_a_check(module, capsys):
    """Its twin against torch, and its circulation."""
    assert 0 < module.main() < 2e-5
    error, found = capsys.readouterr().out.splitlines()
    assert float(error.removeprefix("error of the circulation: ")) < 2e-5
    assert found.startswith("kernels and torch differ by ")


def test_a_wrong_force_is_found(module):
    class Wrong(module.PointVortex):
        def forward(self, state):
            force, drag = super().forward(state)
            return 1.01 * force, drag

    assert Wrong([0.0, 0.0], 1.0).twin() is None
    assert 0.005 < module.circulation_error(Wrong([0.1, 0.0], 3.0)) < 0.02


def test_the_force_changes_with_time(module):
    vortex = module.PointVortex([0.0, 0.0], 2.0 * torch.pi, period=1.0)
    found = vortex.turn(torch.tensor([0.0, 0.25, 0.75], dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor([1.0, 1.5, 0.5], dtype=torch.float64))
