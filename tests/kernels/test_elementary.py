"""exp and log of float32 on a CPU against numpy in double."""

import numpy as np
import pytest
import torch

pytest.importorskip("llvmlite")

from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.language import tl, triton


@triton.jit
def _both(x, exponential, logarithm, count, BLOCK: tl.constexpr):
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    value = tl.load(x + index, mask, 0.0)
    tl.store(exponential + index, tl.exp(value), mask)
    tl.store(logarithm + index, tl.log(value), mask)


def _functions(x, lanes=8):
    given = torch.as_tensor(np.asarray(x, dtype=np.float32))
    made = torch.empty_like(given), torch.empty_like(given)
    cpu.launch(_both, (-(-len(given) // lanes),), given, *made, len(given), BLOCK=lanes)
    return [part.numpy() for part in made]


def _errors(found, exact):
    """In units of the last place of the exact value."""
    last = np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)
    return np.abs(found.astype(np.float64) - exact) / last


def test_exp_is_within_two_units_of_the_last_place():
    x = np.concatenate([np.linspace(-104, 88.72, 400_001), np.linspace(-1, 1, 100_001), [1e-30, -1e-30]])
    x = x.astype(np.float32)
    assert _errors(_functions(x)[0], np.exp(x.astype(np.float64))).max() < 2


def test_log_is_within_two_units_of_the_last_place():
    rng = np.random.default_rng(1)
    x = np.concatenate(
        [np.exp(rng.uniform(-103, 88.7, 400_000)), rng.uniform(0.5, 2, 200_000), 1 + 1e-6 * rng.normal(size=1000)]
    )
    x = x.astype(np.float32)
    x = x[x > 0]
    assert (x < 2.0**-126).sum() > 1000  # denormal ones too
    assert _errors(_functions(x)[1], np.log(x.astype(np.float64))).max() < 2


@pytest.mark.parametrize("lanes", [1, 8])
def test_special_numbers(lanes):
    x = [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, 100.0, -110.0, 3e38, -3e38, -1.0, 1.0]
    exponential, logarithm = _functions(x, lanes)
    np.testing.assert_array_equal(
        exponential, np.array([1, 1, np.inf, 0, np.nan, np.e, np.inf, 0, np.inf, 0, 1 / np.e, np.e], np.float32)
    )
    nan, inf = np.nan, np.inf
    log = [-inf, -inf, inf, nan, nan, 0, np.log(100), nan, np.log(np.float32(3e38)), nan, nan, 0]
    np.testing.assert_array_equal(logarithm, np.array(log, np.float32))
