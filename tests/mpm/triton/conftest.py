"""One width of the kernels for all bodies."""

import pytest

try:
    from gaussian_swaying.mpm.triton import fused_total
except ImportError:
    fused_total = None


@pytest.fixture(autouse=True)
def _one_width(monkeypatch):
    """The number of lanes is a constant of the compiled kernel: the same for all bodies."""
    if fused_total is not None:
        monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 4)
