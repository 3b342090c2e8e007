"""What all tests of commands share."""

import pytest

from gaussian_swaying import _program as program


@pytest.fixture(autouse=True)
def _not_called():
    """Forget that a test started a command through the installed program."""
    yield
    program._called.clear()
