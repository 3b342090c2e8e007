"""``bench.py stability``: a small map, and what each run counts as.

Covers: .
"""

import pytest
from bench.cases import stability
from bench.cases.stability import REFUSED, RIGHT, TOLD, WARNED, WRONG, judged, sentence, swept, verdict


@pytest.mark.parametrize(("status", "reason", "warned", "found", "word"), [
    ("complete", None, False, [], RIGHT),
    ("complete", None, True, [], WARNED),
    ("complete", None, True, ["grid"], TOLD),
    ("complete", None, False, ["grid"], WRONG),
    ("failed", "Lower `material.E`.", False, [], REFUSED),
    ("diverged", "Remedy: lower `solver.cfl`.", False, [], REFUSED),
    ("failed", "KeyError: 'x'. This is a bug; its traceback is in the folder logs.", False, [], WRONG),
])  # fmt: skip
def test_what_a_run_counts_as(status, reason, warned, found, word):
    assert verdict(status, reason, warned, found) == word


def test_messages_are_told_without_their_numbers():
    first = "a.py:116: UserWarning: The object is 0.39 m long, 2.4 cells of `solver.dx` = 0.16 m, so it can hardly bend"
    assert sentence(first) == "The object is N m long, N cells of `solver.dx` = N m,"
    assert sentence("The simulation diverged at t = 0.08 s, particle 3: it is NaN") == sentence(
        "The simulation diverged at t = 2e-3 s, particle 17: it left the grid"
    )


def test_a_small_map(tmp_path):
    """A sheet of few cells is warned of in each run, and a run whose frames are long is not wrong without a word."""
    axes = {"material.E": [1e5], "wind.flow": [[0.0, 0.0, 0.0], [6.0, 2.0, 0.0]]}
    told, frames = swept("sheet", 0.16, axes, tmp_path)
    row = judged(told, frames, None)
    assert row["letters"] == stability.LETTERS[WARNED] * 2
    assert row["counts"][WARNED] == row["runs"] == 2
    assert row["said"] == {"The object is N m long, N cells of `solver.dx` = N m,": 2}
    moved = {name: [frame | {"displacement_mean": 1.0} for frame in each] for name, each in frames.items()}
    assert judged(told, frames, moved)["counts"][TOLD] == 2
    assert judged([one | {"said": []} for one in told], frames, moved)["counts"][WRONG] == 2


def test_a_map_that_was_stopped_goes_on(tmp_path):
    """A run that is complete is not done again, and one that is not is."""
    axes = {"material.E": [1e5, 2e5]}
    first = swept("sheet", 0.16, axes, tmp_path)
    results = sorted((tmp_path / "runs" / "results").iterdir())
    assert len(results) == 2
    results[1].unlink()
    kept = results[0].stat().st_mtime_ns
    told, frames = swept("sheet", 0.16, axes, tmp_path)
    assert results[0].stat().st_mtime_ns == kept
    assert results[1].exists()
    assert judged(told, frames, None) == judged(*first, None)


def test_a_bent_tube_is_not_silent(tmp_path):
    """On 20 cells along it, but one across, it bends a third less than on a finer grid, and says why."""
    axes = {"material.E": [1e6], "material.density": [30.0], "wind.flow": [[6.0, 2.0, 0.0]]}
    told, frames = swept("rod", 0.02, axes, tmp_path / "coarse")
    finer, reference = swept("rod", 0.01, axes, tmp_path / "fine")
    assert judged(told, frames, reference)["letters"] == stability.LETTERS[TOLD]
    (said,) = told[0]["said"]
    assert "hollow" in said
    assert "cells of `solver.dx` = 0.02 m" in said
    assert "hollow" in finer[0]["said"][0]
