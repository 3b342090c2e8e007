"""Films from a hand: what is measured, and what is shown of it."""

import json
from functools import partial

import pytest
from bench.cases import handheld

from .conftest import HEAD, cells, measure

pytest.importorskip("cv2")


def test_a_film_from_a_hand_and_one_taken_for_a_tripod(monkeypatch):
    monkeypatch.setattr(handheld, "FRAMES", 16)
    monkeypatch.setattr(handheld, "SIZE", (240, 136))
    monkeypatch.setattr(handheld, "Plan", partial(handheld.Plan, starts=1))
    names = ["hand, exposure drifts, real walls", "hand, taken for a tripod"]
    rows = [word for name in names for word in ("--row", name)]
    result, _ = measure("handheld", *rows, "--search", "6", result=json.loads(json.dumps(HEAD)))
    found, missed = cells("handheld.rows", result)
    assert [found[0], missed[0]] == names
    assert float(found[1]) < 0.5 < float(missed[1])
    right, wrong = (result["rows"][name] for name in names)
    assert right["gain"] < 0.1
    assert wrong["moved_px"] == 0 < right["moved_px"]
    assert right["unseen"] == 0
