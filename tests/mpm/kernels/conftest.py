import pytest

from gaussian_swaying.mpm import total


@pytest.fixture(autouse=True)
def _one_width(monkeypatch):
    monkeypatch.setattr(total, "_lanes", lambda sizes: 4)
