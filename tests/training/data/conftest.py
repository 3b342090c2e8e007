"""The writers of small captures of tests/captures."""

import runpy
from pathlib import Path

capture_tools = runpy.run_path(str(Path(__file__).parents[2] / "captures" / "conftest.py"))["capture_tools"]
