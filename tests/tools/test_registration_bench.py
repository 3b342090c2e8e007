"""Registration from no pose: what is counted as right, and what is shown of it."""

import json

import pytest
from bench.cases import registration

from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import HEAD, cells, measure

pytest.importorskip("cv2")


def test_a_camera_that_is_found_and_one_that_is_not(monkeypatch):
    monkeypatch.setattr(registration, "printed_flag", lambda: FlagScene(spacing=0.016, pattern="printed").generate())
    monkeypatch.setattr(registration, "WIDTH", 135)
    monkeypatch.setattr(registration, "HEIGHT", 240)
    result, _ = measure("registration", "--poses", "1", result=json.loads(json.dumps(HEAD)))
    known, found = cells("registration.rows", result)
    assert known[:2] == ["printed flag", "known"]
    assert found[:2] == ["printed flag", "found"]
    assert known[2] == "1 of 1"
    assert float(known[3]) < 0.5
    (row,) = result["rows"][0]["found"]
    assert row["fov"] == pytest.approx(0, abs=1e-9)

    def nothing(*args, **options):
        raise ValueError("The splat was not found")

    monkeypatch.setattr(registration, "register", nothing)
    result, _ = measure("registration", "--poses", "1", result=json.loads(json.dumps(HEAD)))
    assert [line[2:4] for line in cells("registration.rows", result)] == [["0 of 1", "-"]] * 2
