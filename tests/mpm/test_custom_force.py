"""A custom force, from outside the package: examples/custom_force.py, with a device function for the kernels."""

import importlib
import sys
from pathlib import Path

import pytest
import torch
from shared import double

ROOT = Path(__file__).parents[2]


@pytest.fixture
def module(monkeypatch):
    """The example."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    yield importlib.import_module("custom_force")
    sys.modules.pop("custom_force", None)


def test_the_example_ends_in_a_check(module, capsys):
    """Its device function against torch, and its circulation."""
    error, apart = module.main()
    assert error < 2e-5
    assert 0 < apart < 2e-5
    assert capsys.readouterr().out.startswith("error of the circulation: ")


def test_a_wrong_force_is_found(module):
    class Wrong(module.PointVortex):
        device_function = module.PointVortex.device_function

        def forward(self, state):
            force, drag = super().forward(state)
            return 1.01 * force, drag

    error, apart = module.main(Wrong)
    assert error == pytest.approx(0.01, rel=1e-3)
    assert apart > 1e-3


def test_the_force_changes_with_time(module):
    vortex = module.PointVortex([0.0, 0.0], 2.0 * torch.pi, period=1.0)
    found = vortex.turn(double([0.0, 0.25, 0.75]))
    torch.testing.assert_close(found, double([1.0, 1.5, 0.5]))
