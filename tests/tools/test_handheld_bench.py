"""Films from a hand: what is measured, and what is shown of it."""

import json
from functools import partial

import pytest
from bench.cases import handheld

from .conftest import HEAD, cells, measure

pytest.importorskip("cv2")


def test_a_film_from_a_hand(monkeypatch):
    """Without its cameras a fit fails: tests/fitting/test_handheld.py."""
    monkeypatch.setattr(handheld, "FRAMES", 16)
    monkeypatch.setattr(handheld, "SIZE", (240, 136))
    monkeypatch.setattr(handheld, "Plan", partial(handheld.Plan, starts=1, iterations=1))
    name = "hand, exposure drifts, real walls"
    result, _ = measure("handheld", "--row", name, "--search", "2", result=json.loads(json.dumps(HEAD)))
    ((row,), measured) = cells("handheld.rows", result), result["rows"][name]
    assert row[0] == name
    assert float(row[1]) < 0.5
    assert measured["gain"] < 0.1
    assert measured["moved_px"] > 0
    assert measured["unseen"] == 0
