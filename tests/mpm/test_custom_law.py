import importlib
import sys
from pathlib import Path

import pytest
import torch
from shared import peak, seeded, solid

from gaussian_swaying import MPMSolver
from gaussian_swaying.mpm.laws.plastic import Sand

ROOT = Path(__file__).parents[2]


@pytest.fixture
def saint(monkeypatch):
    """The law of the example."""
    monkeypatch.syspath_prepend(str(ROOT / "examples/materials"))
    yield importlib.import_module("custom_law").SaintVenant
    sys.modules.pop("custom_law", None)


@pytest.mark.parametrize("case", ["total", "updated", "beside sand"])
def test_it_runs_in_the_kernels(kernel_device, case, saint):
    generator = seeded(0)
    position = (0.06 + 0.18 * torch.rand(12, 3, generator=generator)).to(kernel_device)
    laws, index = saint(1.5), None
    if case == "beside sand":
        laws, index = [Sand(), saint(1.5), saint(0.5)], (torch.arange(12) % 3).to(kernel_device)
    points = solid(position, 1e-4, law=laws, law_index=index)
    ends = []
    for transfer in ("torch", "kernels"):
        solver = MPMSolver(0.1, "total" if case == "total" else "updated", transfer=transfer)
        with torch.no_grad():
            state = solver.init_state(points, torch.randn(12, 3, generator=generator.manual_seed(1)).to(kernel_device))
            ends.append(solver.rollout(state, 2e-3, 4))
    for name in ("velocity", "F_elastic"):
        expected, found = (getattr(end, name) for end in ends)
        assert peak(found - expected) <= 2e-5 * peak(expected)
    assert peak(ends[0].F_elastic - torch.eye(3, device=kernel_device)) > 1e-3


def test_a_law_that_overrides_a_stress_runs_in_torch(saint):
    class Wrong(saint):
        def pk1(self, F, mu, lam, internal=None):
            return 1.01 * super().pk1(F, mu, lam)

    assert saint.device is not None
    assert Wrong.device is None
