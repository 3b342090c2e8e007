import pytest

from gaussian_swaying.kernels import cpu


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for compiled kernels; none is in memory."""
    monkeypatch.setattr(cpu, "cache_folder", lambda: tmp_path / "kernels")
    monkeypatch.setattr(cpu, "_COMPILED", {})
    return tmp_path / "kernels"
