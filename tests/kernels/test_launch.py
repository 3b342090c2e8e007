import importlib.util

import pytest
import torch

from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels import launch as module
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import LANES, call, compiles, lanes, launch, wide


@triton.jit
def _fill(out, n, value, NEGATIVE: tl.constexpr, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(out + k, -value if NEGATIVE else value, k < n)


def test_a_kernel_runs_where_its_tensors_are(device):
    out = torch.zeros(20, device=device)
    launch(_fill, [triton.cdiv(19, 8)])(out, 19, 2.5, NEGATIVE=True, BLOCK=8, num_warps=1)
    assert out.tolist() == [-2.5] * 19 + [0.0]


def test_blocks_of_a_cpu_have_lanes_of_their_own():
    there, here = torch.device("cuda"), torch.device("cpu")
    assert (lanes(there, 128), lanes(there, 128, 1)) == (128, 128)
    assert (lanes(here, 128), lanes(here, 128, 1)) == (LANES, 1)


def test_only_newer_gpus_add_four_numbers_at_once(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    assert wide(torch.device("cuda"))
    assert not wide(torch.device("cpu"))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 9))
    assert not wide(torch.device("cuda"))


def test_the_interpreter_takes_the_blocks_of_a_gpu(monkeypatch):
    monkeypatch.setattr(module, "INTERPRETED", True)
    assert lanes(torch.device("cpu"), 128, 1) == 128


def test_a_cpu_needs_llvmlite(monkeypatch):
    assert compiles("cpu")
    assert compiles("cuda") == (torch.cuda.is_available() and importlib.util.find_spec("triton") is not None)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "llvmlite" else find(name))
    compiles.cache_clear()
    try:
        assert not compiles("cpu")
    finally:
        compiles.cache_clear()


def test_a_function_between_launches_is_recorded_on_a_cpu_only():
    calls = []
    with cpu.recording() as made:
        call(lambda: calls.append("cpu"), torch.device("cpu"))
        call(lambda: calls.append("cuda"), torch.device("cuda"))
    made.replay()
    assert calls == ["cpu", "cuda", "cpu"]


def test_tensors_of_a_kind_without_kernels_are_refused():
    with pytest.raises(KeyError, match="float16"):
        launch(_fill, (1,))(torch.zeros(8, dtype=torch.float16), 8, 1.5, NEGATIVE=False, BLOCK=8)
