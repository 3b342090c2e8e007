import importlib
import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def tool_of(path):
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / "tools" / path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tool(request):
    folder = ROOT / "tools" / "datasets"
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(request.module.TOOL)
    finally:
        sys.path.remove(str(folder))
        for path in folder.glob("*.py"):
            sys.modules.pop(path.stem, None)


def beside(name):
    @pytest.fixture(scope="module")
    def module(tool):
        return sys.modules[name]

    return module
