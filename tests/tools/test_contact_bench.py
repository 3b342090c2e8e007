"""The measurements of contact: their cases are what they say, rows are kept, and tables can be made of them."""

import argparse
import json
from functools import partial

import pytest
import torch
from bench.cases import contact
from bench.problems.contacts import crossings, sheet_triangles

from .conftest import shown

CPU = torch.device("cpu")


@pytest.mark.parametrize("case", contact.CASES)
def test_the_cases_are_what_they_say(case):
    solver, state, dt = contact.prepare(200, case, CPU)
    end = solver.rollout(state, dt, 3)
    stage = solver.bound.contact
    assert (stage is None) == (case == "off")
    if case != "off":
        assert (len(stage.lists.first) > 0) == ("in contact" in case)
    upper = end.velocity[solver.points.count // 2 :, 2].mean()
    assert (abs(float(upper)) > 1e-6) == ("in contact" in case)
    if case == "all in contact":  # two equal sheets: each gets half the momentum
        torch.testing.assert_close(float(upper), -0.25, rtol=0.02, atol=0)


def test_rows_are_recorded_and_shown(monkeypatch):
    monkeypatch.setattr(contact, "collision", partial(contact.collision, points=225, frames=10))
    options = argparse.Namespace(points="100", repeats=1, speeds="5", pile=0.0, device="cpu")
    result = {"device": "a CPU", "versions": {"torch": "2"}, "seed": 0, "rows": [], "collisions": []}
    saved = []
    contact.measure(options, result, lambda now: saved.append(json.dumps(now)))
    assert [row["case"] for row in result["rows"]] == list(contact.CASES)
    assert len(saved) == len(contact.CASES) + 1
    (row,) = result["collisions"]
    assert (row["crossings"], row["closer_than_half"]) == (0, 0.0)
    contact.measure(options, result, lambda now: None)
    assert len(result["rows"]) == len(contact.CASES)  # measured again, not twice
    assert shown("contact.cost", result)[-1].startswith("| 98 |")
    assert "thicknesses" in shown("contact.collisions", result)[-1]


@pytest.mark.slow(twin="test_a_pile_at_rest_stays_at_rest")
def test_a_pile_rests_for_a_second():
    (row,) = contact.pile(1.0, CPU, layers=2, per_side=2)
    assert row["kinetic"] < 1e-4
    assert row["top"] == pytest.approx(1.0, abs=0.05)  # the ground lies half a thickness below the lower layer
    told = shown("contact.pile", {"device": "a CPU", "versions": {"torch": "2"}, "seed": 0, "pile": [row]})
    assert told[-1].startswith("| 1 | ")
    assert told[-1].endswith(" | +0.0e+00 | +0.0e+00 | +0.0000 | +0.00 | - |")
    assert shown("contact.pile", {}) == ["Not recorded."]


def test_crossings_are_counted():
    """Two squares that cross in the shape of a plus, and apart from each other."""
    flat = torch.tensor([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]])
    upright = torch.tensor([[0.3, 0.2, -0.5], [0.3, 0.2, 0.5], [0.3, 0.9, -0.5], [0.3, 0.9, 0.5]])
    triangles = torch.cat([sheet_triangles(2, 2), sheet_triangles(2, 2, 4)])
    assert crossings(torch.cat([flat, upright]), triangles) > 0
    assert crossings(torch.cat([flat, upright + torch.tensor([2.0, 0, 0])]), triangles) == 0
