"""The notebooks in examples/notebooks: their cells run one after the other, at a small size."""

import json
from pathlib import Path

import matplotlib as mpl
import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
SMALL = {
    "first_flag": ("SPACING, FRAMES = 0.03, 26", "SPACING, FRAMES = 0.1, 6"),
    "wind_by_gradient": ("SIDE, STEPS, ROUNDS = 6, 20, 8", "SIDE, STEPS, ROUNDS = 4, 10, 8"),
    "aero_force": ("0.0, 90.0, 91", "0.0, 90.0, 7"),
}
"""For each notebook the line that says how large it is, and what stands there in the tests."""


def test_these_are_all():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(SMALL)


@pytest.mark.parametrize("name", SMALL)
def test_cells_run_in_their_order(name):
    mpl.use("Agg")
    given = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in given["cells"] if cell["cell_type"] == "code"]
    code = "\n\n".join(cells)
    assert len(code.splitlines()) < 80
    assert SMALL[name][0] in code
    assert "assert " in code  # each ends with a check of what it shows
    assert all(not cell.get("outputs") for cell in given["cells"])
    exec(compile(code.replace(*SMALL[name]), f"{name}.ipynb", "exec"), {"__name__": "__main__"})
