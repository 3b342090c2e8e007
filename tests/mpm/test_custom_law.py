"""A custom law, from outside the package: one file, named by its class path in a YAML, and a twin for the kernels."""

import importlib
import sys
from pathlib import Path

import pytest
import torch
import yaml

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.mpm.laws import LAWS
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.recording.trajectory import load_trajectory

ROOT = Path(__file__).parents[2]

LAW = '''
"""Saint Venant and Kirchhoff: Hooke's law in the Green strain."""

import torch

from gaussian_swaying import ConstitutiveLaw
from gaussian_swaying.geometry.linalg import matmul3
from gaussian_swaying.mpm.twins import Numbers, Twin


class Saint(ConstitutiveLaw):
    """Hooke's law in the Green strain, times a factor."""

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    def twin(self):
        from saint_twin import FUNCTIONS

        return Twin(FUNCTIONS, numbers=Numbers(1, lambda: [self.factor]))

    def _strain(self, F):
        return 0.5 * (matmul3(F.mT, F) - torch.eye(3, dtype=F.dtype, device=F.device))

    def energy(self, F, mu, lam, internal=None):
        E = self._strain(F)
        trace = E.diagonal(dim1=-2, dim2=-1).sum(-1)
        return self.factor * (mu * E.square().sum((-1, -2)) + 0.5 * lam * trace.square())

    def pk1(self, F, mu, lam, internal=None):
        E = self._strain(F)
        trace = (lam * E.diagonal(dim1=-2, dim2=-1).sum(-1))[..., None, None]
        eye = torch.eye(3, dtype=F.dtype, device=F.device)
        return self.factor * matmul3(F, 2 * mu[..., None, None] * E + trace * eye)

    def moduli(self, F, mu, lam, internal=None):
        size = F.square().sum((-1, -2)).clamp(min=3)
        return self.factor * (2 * mu + lam) * size, self.factor * (2 * mu + 3 * lam) * size
'''

TWIN = """
import triton
import triton.language as tl

from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.geometry.linalg_triton import matmul, transpose


@triton.jit
def pk1(F, mu, lam, internal, p):
    C = matmul(transpose(F), F)
    pressure = 0.5 * lam * (C[0] + C[4] + C[8] - 3)
    s = p[0]
    stress = (
        s * (mu * (C[0] - 1) + pressure), s * mu * C[1], s * mu * C[2], s * mu * C[3],
        s * (mu * (C[4] - 1) + pressure), s * mu * C[5], s * mu * C[6], s * mu * C[7],
        s * (mu * (C[8] - 1) + pressure),
    )
    return matmul(F, stress)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


FUNCTIONS = LawFunctions(pk1=pk1, kirchhoff=kirchhoff)
"""


@pytest.fixture
def saint(tmp_path, monkeypatch):
    """The modules of a user's folder, and the law."""
    (tmp_path / "saint_law.py").write_text(LAW)
    (tmp_path / "saint_twin.py").write_text(TWIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("saint_law").Saint
    for name in ("saint_law", "saint_twin"):
        sys.modules.pop(name, None)


def _run(folder, law):
    """Two frames of a flag of twelve by eight Gaussians, held at its left edge."""
    pole = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.11, None, None]}}
    changes = {
        "material": {"law": law},
        "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1}}},
        "solver": {"dx": 0.2, "boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": pole}}]},
        "camera": {"class_path": "OrbitCamera", "init_args": {"width": 32, "height": 18}},
    }
    folder.mkdir()
    (folder / "changes.yaml").write_text(yaml.safe_dump(changes))
    configs = ["--config", str(ROOT / "configs/sim/flag.yaml"), "--config", str(folder / "changes.yaml")]
    assert main([*configs, "--frames", "2", "--device", "cpu", "--output", str(folder / "out")]) == 0
    stored = yaml.safe_load((folder / "out" / "config.yaml").read_text())
    positions = [load_trajectory(folder / "out" / "trajectory.npz", frame)[0] for frame in (0, 1)]
    return stored["material"]["law"], positions


def test_a_custom_law_runs_from_a_yaml(tmp_path, saint):
    assert "Saint" not in LAWS
    written, moved = _run(tmp_path / "one", {"class_path": "saint_law.Saint", "init_args": {"factor": 2.0}})
    assert written == {"class_path": "saint_law.Saint", "init_args": {"factor": 2.0}}
    soft = _run(tmp_path / "soft", {"class_path": "saint_law.Saint"})[1]
    corotated = _run(tmp_path / "corotated", {"class_path": "FixedCorotated"})[1]
    assert float((moved[1] - moved[0]).abs().max()) > 1e-3
    assert float((moved[1] - soft[1]).abs().max()) > 1e-6
    # of the same stiffness at rest
    assert float((soft[1] - corotated[1]).abs().max()) < 0.1 * float((soft[1] - soft[0]).abs().max())


@pytest.mark.parametrize("case", ["total", "updated", "beside sand"])
def test_its_twin_runs_in_the_kernels(kernel_device, case, saint):
    generator = torch.Generator().manual_seed(0)
    position = (0.06 + 0.18 * torch.rand(12, 3, generator=generator)).to(kernel_device)
    laws, index = saint(1.5), None
    if case == "beside sand":
        laws, index = [Sand(), saint(1.5), saint(0.5)], (torch.arange(12) % 3).to(kernel_device)
    points = MaterialPoints.create(
        position, volume=1e-4, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3, law=laws, law_index=index
    )
    ends = []
    for transfer in ("torch", "triton"):
        solver = MPMSolver(0.1, formulation="total" if case == "total" else "updated", transfer=transfer)
        with torch.no_grad():
            state = solver.init_state(points, torch.randn(12, 3, generator=generator.manual_seed(1)).to(kernel_device))
            ends.append(solver.rollout(state, 2e-3, 4))
    for name in ("velocity", "F_elastic"):
        expected, found = (getattr(end, name) for end in ends)
        assert float((found - expected).abs().max()) <= 2e-5 * float(expected.abs().max())
    assert float((ends[0].F_elastic - torch.eye(3, device=kernel_device)).abs().max()) > 1e-3


def test_a_law_without_a_twin_runs_in_torch(saint):
    class Stiffer(saint):
        """It may do anything, so it does not inherit the twin."""

    assert Stiffer().twin() is None
    assert saint().twin() is not None
