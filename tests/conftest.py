import importlib.util
import os
import shutil
import signal
import sys
from pathlib import Path

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "tools")]  # last, so as to shadow nothing
os.environ["GAUSSIAN_SWAYING_CHECKS"] = "1"
os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as tools/sim.py, and for the same reason

import nightly
import pytest
import torch

from gaussian_swaying import _program as program


def pytest_collection_modifyitems(config, items):
    """Skip `gpu` tests without CUDA, unless GS_REQUIRE_GPU=1 asks for them; leave `slow` ones to the nightly run.

    `gpu` tests run there whether they are `slow` or not.
    """
    require_gpu = os.environ.get("GS_REQUIRE_GPU") == "1"
    marks = config.getoption("-m") or ""
    for item in items:
        if "gpu" in item.keywords and not torch.cuda.is_available() and not require_gpu:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
        if nightly.is_left(item) and "gpu" not in item.keywords and "slow" not in marks:
            item.add_marker(pytest.mark.skip(reason="slow: run with -m slow, as .ci/nightly does"))


@pytest.fixture(scope="session")
def chromium():
    """Path of a Chromium that playwright can drive. Without one a test is skipped, or fails where CI is set."""
    found = [shutil.which(name) for name in ("chromium", "chromium-browser", "google-chrome")]
    path = next((path for path in found if path), None)
    missing = "an installed Chromium" if path is None else "playwright"
    if path is None or importlib.util.find_spec("playwright") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"needs {missing}")
    return path


@pytest.fixture(scope="session")
def node():
    """Path of Node.js, as :func:`chromium`."""
    path = shutil.which("node")
    if path is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("needs an installed Node.js")
    return path


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    return torch.device(request.param)


kernel_device = device
"""Where kernels run: compiled by LLVM on a CPU, or by Triton on a GPU."""


@pytest.fixture(scope="session")
def parser():
    from gaussian_swaying.simulation.simulation import Simulation

    return Simulation.parser()


@pytest.fixture
def use_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.fixture
def default_signals():
    """Handlers as a shell starts programs with, whatever started the tests."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _not_called():
    yield
    program._called.clear()


# now that the environment is set
from small_films import own  # noqa: E402, F401
from small_scenes import flag_ply, make_cloud, make_scene, make_simulation  # noqa: E402, F401
