"""One width of the kernels for all bodies."""

import pytest

from gaussian_swaying.mpm import total_run


@pytest.fixture(autouse=True)
def _one_width(monkeypatch):
    """The number of lanes is a constant of the compiled kernel: the same for all bodies."""
    monkeypatch.setattr(total_run, "_lanes", lambda sizes: 4)
