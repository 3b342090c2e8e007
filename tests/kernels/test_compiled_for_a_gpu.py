"""Kernels compile for a GPU: Triton's interpreter and the compiler for a CPU take more than its compiler does."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

PROGRAM = Path(__file__).with_name("compile_for_a_gpu.py")
KERNELS = {
    *("updated_load", "updated_particles", "updated_pin", "updated_nodes", "updated_read", "pin_mass"),
    *("total_particles", "total_nodes", "total_read"),
}


@pytest.mark.skipif(torch.cuda.is_available(), reason="the GPU runs the kernels")
def test_the_kernels_of_rollouts_compile(tmp_path):
    pytest.importorskip("triton", reason="needs triton, which is available on Linux only")
    given = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    made = subprocess.run([sys.executable, str(PROGRAM)], env=given, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert set(made.stdout.split()) == KERNELS
