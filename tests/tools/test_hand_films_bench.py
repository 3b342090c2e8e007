"""Fits of films from a hand: what is recorded of a command, of one that is refused, and what is shown."""

import json

import pytest
from bench.cases import hand_films

from .conftest import HEAD, cells, measure

FIT = """
import json, pathlib, sys
assert sys.argv[1:3] == ["fit", "--config"]
assert pathlib.Path(sys.argv[3]).is_file()
if "moving" in sys.argv[3]:
    print("The video does not tell them apart.", file=sys.stderr)
    sys.exit(2)
pathlib.Path("fit").mkdir()
found = {"wind.speed": (2.18, 0.1), "wind.azimuth": (47.0, 2.0), "material.E": (4e3, 4e2), "film.start": (0.19, 0.01)}
rows = [{"name": name, "value": value, "standard_error": error} for name, (value, error) in found.items()]
told = {"values": rows, "verdict": "doubtful", "why": ["Rough."], "motion_explained": {"0": 0.9}}
pathlib.Path("fit/result.json").write_text(json.dumps(told))
"""


@pytest.fixture
def films(tmp_path):
    """Two films of a flag without anything that is read by a fit."""
    for name, start in (("still", 0.2), ("moving", -0.2)):
        folder = tmp_path / "pole_flag" / name
        folder.mkdir(parents=True)
        (folder / "fit.yaml").write_text("{}")
        truth = {"speed": 2.0, "azimuth": 50.0, "E": 5e3, "start": start}
        (folder / "truth.json").write_text(json.dumps(truth))
    return tmp_path


def test_films_are_fitted_in_processes_of_their_own(monkeypatch, films):
    monkeypatch.setattr(hand_films, "COMMAND", FIT)
    result, _ = measure("hand_films", "--films", films, result=json.loads(json.dumps(HEAD)))
    assert list(result["rows"]) == ["pole flag, moving", "pole flag, still"]
    row = result["rows"]["pole flag, still"]
    assert row["errors"] == pytest.approx({"wind.speed": 0.09, "wind.azimuth": -3.0, "material.E": -0.2})
    assert row["standard_errors"] == pytest.approx({"wind.speed": 0.05, "wind.azimuth": 2.0, "material.E": 0.08})
    assert row["why"] == ["Rough."]
    measure("hand_films", "--films", films)  # an earlier fit is in the way of none
    assert result["rows"]["pole flag, moving"]["why"] == ["The video does not tell them apart."]
    moving, still = cells("hand_films.rows", result)
    assert moving[:7] == ["pole flag, moving", "", "", "", "", "failed", "yes"]
    assert still[:7] == ["pole flag, still", "+9.0 %", "-3.0°", "-20.0 %", "0.19 s", "doubtful", ""]


def test_one_film_is_chosen_and_a_folder_without_any_is_named(monkeypatch, films, tmp_path):
    monkeypatch.setattr(hand_films, "COMMAND", FIT)
    result, _ = measure("hand_films", "--films", films, "--film", "pole_flag/still")
    assert list(result["rows"]) == ["pole flag, still"]
    with pytest.raises(SystemExit, match="make_hand_films"):
        measure("hand_films", "--films", tmp_path / "none")
