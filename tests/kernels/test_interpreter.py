"""The kernels with the blocks of a GPU, in Triton's interpreter: on a machine without a GPU nothing else runs those.

A block of a GPU has many lanes and several axes, sums the particles of a cell across lanes and adds to the grid
atomically; on a CPU, kernels are compiled for blocks of one axis. The interpreter is slow, so one process runs a few
tests of other files in it.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
TESTS = [
    "mpm/kernels/test_agreement.py::test_cells_of_any_size[2048-cpu-('total', [1, 3, 0, 64, 65, 130])]",
    "mpm/kernels/test_agreement.py::test_cells_of_any_size[1-cpu-('updated', [3, 0, 64])]",
    "mpm/kernels/test_agreement.py::test_kernels_do_what_torch_does[cpu: total, corotated, nodes, hinge and clamp]",
    "mpm/kernels/test_adjoint.py::test_gradients_of_a_rollout[cpu-pins of both kinds]",
]


@pytest.mark.skipif(torch.cuda.is_available(), reason="the GPU runs the kernels")
def test_the_blocks_of_a_gpu_do_what_torch_does():
    pytest.importorskip("triton", reason="needs triton, which is available on Linux only")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(f"tests/{test}" for test in TESTS)]
    given = {**os.environ, "TRITON_INTERPRET": "1"}
    made = subprocess.run(command, cwd=ROOT, env=given, capture_output=True, text=True, check=False)
    assert f"{len(TESTS)} passed" in made.stdout, made.stdout + made.stderr
    assert made.returncode == 0


# ---- kernels compile for a GPU: Triton's interpreter and the compiler for a CPU take more than its compiler does


PROGRAM = Path(__file__).with_name("compile_for_a_gpu.py")
KERNELS = {
    "rollouts": {
        *("updated_load", "updated_particles", "updated_pin", "updated_nodes", "updated_read", "pin_mass"),
        *("total_particles", "total_nodes", "total_read"),
    },
    "gradient": {
        *("total_particles", "total_nodes", "total_read", "total_bend"),
        *("keep_nodes", "nodes_adjoint", "particles_adjoint", "bend_adjoint"),
    },
}


@pytest.mark.skipif(torch.cuda.is_available(), reason="the GPU runs the kernels")
@pytest.mark.parametrize("part", ["rollouts", pytest.param("gradient", marks=pytest.mark.slow)])
def test_the_kernels_compile(part, tmp_path):
    pytest.importorskip("triton", reason="needs triton, which is available on Linux only")
    given = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    made = subprocess.run([sys.executable, str(PROGRAM), part], env=given, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert set(made.stdout.split()) == KERNELS[part]
