"""The comparison of folds: command lines, references of different lengths, crossings, and its tables."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from bench.cases import flags, folds

from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure


@pytest.mark.parametrize("name", ["free_04", "contact_04", "contact_015"])
def test_rows_differ_in_contact_and_grid_only(name):
    fold = folds.ROWS[name]
    settings = Simulation.parser().parse_args(folds.arguments(fold))
    assert settings.solver.dx == fold.dx
    assert settings.material.thickness == flags.REFERENCES[folds.PATTERN].thickness
    if fold.contact:
        assert (settings.contact.thickness, settings.contact.friction) == (folds.DISTANCE, 0.0)
    else:
        assert settings.contact is None
    (pin,) = settings.solver.boundaries
    assert pin.init_args.kind == "hinge"


def _reference(folder, frames, lift):
    """A motion of a coarse flag that rises."""
    pattern = flags.REFERENCES[folds.PATTERN]
    flat = pattern.rest(np.stack(np.meshgrid([0, 0.5, 1], [0, 1], indexing="ij"), -1).reshape(-1, 2))[0]
    moved = np.stack([flat + np.array([0, 0, lift * k]) for k in range(frames)]).astype(np.float32)
    uv = np.stack(np.meshgrid([0, 0.5, 1], [0, 1], indexing="ij"), -1).reshape(-1, 2)
    faces = np.array([[0, 2, 3, 1], [2, 4, 5, 3]])
    settings = {"cells": 3, "quality": 8, "width": 1.2, "height": 0.8}
    path = folder / f"pattern{folds.PATTERN}"
    path.mkdir(parents=True)
    np.savez(path / "cloth.npz", positions=moved, faces=faces, uv=uv, columns=2, rows=1, settings=json.dumps(settings))
    return path


def test_references_are_described_and_compared_over_the_frames_that_both_have(tmp_path):
    first = _reference(tmp_path / "blender", 31, 0.0)
    _reference(tmp_path / "newton", 26, 0.024)
    known = {"coarser": {"cells": 2, "quality": 8, "chamfer": 0.01, "frames_compared": 3, "corresponding": 1}}
    (first / "uncertainty.json").write_text(json.dumps({"variants": known}))
    found = folds.describe(tmp_path)
    assert list(found["references"]) == ["blender", "newton"]
    assert found["references"]["newton"]["frames"] == 26
    assert found["references"]["blender"]["crossings"] == []
    assert found["references"]["blender"]["uncertainty"]["coarser"]["chamfer"] == 0.01
    # frames 0 and 25: 0.6 m up, of which the surfaces, which overlap, see a part
    assert 0.01 < found["apart"]["blender newton"] < 0.25
    with pytest.raises(SystemExit, match="has none of blender"):
        measure("folds", "--dataset", tmp_path / "nothing", "--rows", "free_04")


@pytest.mark.slow(twin="test_a_row_of_a_flag_is_simulated_and_compared")
def test_a_row_is_simulated_and_compared(tmp_path):
    """Two frames of a coarse flag."""
    _reference(tmp_path / "set" / "blender", 2, 0.0)
    options = SimpleNamespace(device="cpu", frames=2, points=500)
    row = folds._compared(folds.Fold(True, 0.1), tmp_path / "set", options, tmp_path / "run")
    assert row["status"] == "complete"
    assert row["to"]["blender"]["frames"] == 2
    assert row["to"]["blender"]["chamfer_share"] < 0.02
    assert folds.folder_crossings(tmp_path / "run", (0, 1)) == [0, 0]


def test_the_page_shows_who_is_how_far_from_whom():
    def reference(share):
        return {
            "cells": 80, "quality": 32, "frames": 250, "crossings": [0, 4],
            "uncertainty": {"coarser": {"cells": 60, "quality": 16, "chamfer": share, "frames_compared": 50}},
        }  # fmt: skip

    row = {"status": "complete", "crossings": [0, 0], "to": {"blender_contact": {"chamfer_share": 0.034}}}
    result = HEAD | {
        "references": {"blender": reference(0.01), "blender_contact": reference(0.015)},
        "apart": {"blender blender_contact": 0.02},
        "rows": {"contact_04": row, "free_04": {"failed": "x"}},
    }
    rows = {row[0]: row[1:] for row in cells("folds.rows", result)}
    assert rows["ours, contact, dx = 0.04 m"] == ["-", "3.40 %", "0"]
    assert rows["ours, no contact, dx = 0.04 m"] == ["failed", "failed", "-"]
    assert rows["Blender, contact"] == ["2.00 %", "", "4"]
    assert rows["the reference itself, solved otherwise"] == ["1.00 %", "1.50 %", ""]
    assert cells("folds.goals", result)[0][1:] == ["3.40 %, 1.50 % + 2 %", "yes"]
    assert cells("folds.references", result)[-1][1:] == ["80", "32", "250", "coarser (60 cells, 16 steps) 1.50 %"]
