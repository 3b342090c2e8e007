"""What tests of the compiler of kernels share."""

import pytest
import torch

from gaussian_swaying.kernels import cpu


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for compiled kernels; none is in memory."""
    monkeypatch.setattr(cpu, "cache_folder", lambda: tmp_path / "kernels")
    monkeypatch.setattr(cpu, "_COMPILED", {})
    return tmp_path / "kernels"


@pytest.fixture
def use_threads():
    """``torch.set_num_threads``, undone afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)
