"""Time and memory of the command that fits a film: what is recorded of it, and what is shown."""

import json

import pytest
from bench.cases import film_fit

from .conftest import HEAD, cells, measure

FIT = """
import json, pathlib, sys
held = bytearray(300_000_000)
held[::4096] = b"x" * len(held[::4096])
assert sys.argv[1:5] == ["fit", "film.mp4", "--splat", "my.ply"]
folder = pathlib.Path("out/result")
folder.mkdir(parents=True)
found = {"wind.speed": 9.9, "wind.azimuth": 33.0, "material.E": 4.5e4}
rows = [{"name": name, "value": value} for name, value in found.items()]
(folder / "result.json").write_text(json.dumps({"values": rows, "verdict": "doubtful"}))
"""


def test_what_a_command_takes_and_finds(monkeypatch):
    monkeypatch.setattr(film_fit, "COMMAND", FIT)
    made = []
    monkeypatch.setattr(film_fit, "write_case", lambda folder, size, still, moving: made.append((still, moving)))
    result, _ = measure("film_fit", "--device", "cpu", "--seconds", "4", result=json.loads(json.dumps(HEAD)))
    (row,) = result["rows"]
    assert made == [(1.5, 2.5)]
    assert row["frames"] == 120
    assert 3e8 < row["peak_bytes"] < 2e9
    assert row["speed_error"] == pytest.approx(0.1)
    assert row["azimuth_error_deg"] == pytest.approx(2.0)
    ((film, *_, speed, azimuth, E, verdict),) = cells("film_fit.rows", result)
    assert (film, speed, azimuth, E, verdict) == ("4 s", "+10.0 %", "2.0°", "-10.0 %", "doubtful")


def test_a_command_that_fails_is_no_row(monkeypatch):
    monkeypatch.setattr(film_fit, "COMMAND", "import sys; sys.exit(2)")
    monkeypatch.setattr(film_fit, "write_case", lambda *given: None)
    with pytest.raises(RuntimeError, match="fit ended with 2"):
        film_fit.measured(3.0, "cpu")
