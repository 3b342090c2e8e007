import os
import subprocess
import sys
from pathlib import Path

import pytest

from gaussian_swaying.kernels.language import Compiler, Function

triton = Compiler()
tl = triton.language
ROOT = Path(__file__).parents[2]


@triton.jit
def _plain(x):
    """One more."""
    return x + 1


@triton.jit(do_not_specialize=("x",))
def _with_options(x):
    return x + 2


def test_a_kernel_is_its_source():
    assert isinstance(_plain, Function)
    assert isinstance(_with_options, Function)
    assert (_plain.__name__, _plain.__doc__) == ("_plain", "One more.")
    assert _plain.fn(1) == 2
    assert repr(_plain) == f"{__name__}._plain"
    assert _plain.cache_key == Function(_plain.fn).cache_key != _with_options.cache_key


def test_names():
    assert tl.PropagateNan.ALL.name == "PropagateNan.ALL"
    for owner in (tl, tl.load):
        with pytest.raises(AttributeError):  # as what looks for special methods expects
            _ = owner.__wrapped__


def test_sizes_are_those_of_triton():
    assert [triton.cdiv(n, 8) for n in (0, 1, 8, 9)] == [0, 1, 1, 2]
    assert [triton.next_power_of_2(n) for n in (0, 1, 2, 3, 64, 65)] == [1, 1, 2, 4, 64, 128]


ASK = """
import sys
import {module}
from gaussian_swaying.kernels.language import INTERPRETED, ON_GPU, Compiler, triton
print(INTERPRETED, ON_GPU, isinstance(triton, Compiler), "triton" in sys.modules)
"""


def _ask(module="gaussian_swaying.mpm.total", **environment):
    given = {**os.environ, "CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": str(ROOT), **environment}
    made = subprocess.run(
        [sys.executable, "-c", ASK.format(module=module)], env=given, capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return made.stdout.split()


def test_without_a_gpu_triton_is_not_imported():
    """It takes a second, and need not be installed."""
    assert _ask(TRITON_INTERPRET="0") == ["False", "False", "True", "False"]
