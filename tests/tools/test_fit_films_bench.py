"""Small films with known answers: what a film shows, and what is counted of their fits."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
import yaml
from bench.cases import fit_films
from bench.cases.fit_films import covered, misses
from bench.problems.fit_films import FPS, KINDS, Film, drawn, make, speeds

from gaussian_swaying.fitting.videos import read_videos

from .conftest import HEAD, cells, measure

pytest.importorskip("cv2")


def test_films_that_begin_earlier_and_later(tmp_path):
    """The first frames are still, or those of the motion are cut."""
    films = {start: Film("pole flag", 4.0, 40.0, 8e3, seconds=0.3, start=start) for start in (0.0, 0.1, -0.1)}
    frames = {}
    for start, film in films.items():
        make(film, tmp_path / str(start))
        (video,) = read_videos(tmp_path / str(start))
        assert len(video.times) == round(0.3 * FPS)
        frames[start] = video.images.float()

    def apart(a, b):
        return float((a - b).abs().mean())

    noise = apart(frames[0.1][0], frames[0.1][2])
    assert apart(frames[0.1][0], frames[0.1][3]) < 1.5 * noise  # the motion begins with this frame
    assert apart(frames[0.1][0], frames[0.1][8]) > 1.5 * noise
    assert apart(frames[-0.1][0], frames[0.0][3]) < apart(frames[-0.1][0], frames[0.0][0])
    base = yaml.safe_load((tmp_path / "0.0/base.yaml").read_text())
    assert base["wind"]["flow"] == [KINDS["pole flag"].speed, 0.0, 0.0]  # not the answer


def test_a_wind_with_gusts_has_their_intensity_and_time_scale():
    """Of a film so long that its own numbers are those of the process."""
    film = Film("banner", 4.0, 40.0, 8e3, seconds=2000.0, gusts=(0.2, 0.5))
    found = torch.tensor([speed for _, speed in speeds(film)], dtype=torch.float64)
    assert float(found.mean()) == pytest.approx(4.0, rel=0.03)
    assert float(found.std()) == pytest.approx(0.8, rel=0.05)
    off = found - found.mean()
    assert float((off[5:] * off[:-5]).mean() / off.square().mean()) == pytest.approx(math.exp(-1), abs=0.06)


@pytest.mark.parametrize("kind", list(KINDS))
def test_drawn_films_differ_and_bad_starts_stay_in_their_ranges(kind):
    first, second = drawn(kind, 0), drawn(kind, 1)
    assert first.truth != second.truth
    assert first == drawn(kind, 0)
    for film in (first, second):
        for name, entry in film.unknowns(3.0).items():
            assert entry["range"][0] <= entry["start"] <= entry["range"][1]
            assert entry["range"][0] < film.truth[name] < entry["range"][1]
        assert "start" not in film.unknowns()["wind.speed"]


def test_what_is_counted():
    good = {"errors": {"wind.speed": 0.04, "wind.azimuth": -4.0, "material.E": 0.1}}
    good["standard_errors"] = {"wind.speed": 0.03, "wind.azimuth": 1.0, "material.E": 0.2}
    assert not misses(good)
    assert misses(good | {"errors": good["errors"] | {"wind.azimuth": 6.0}})
    assert not misses(good | {"errors": good["errors"] | {"wind.azimuth": 6.0}}, 2)
    assert misses({"verdict": "failed"})
    found = covered([good, {"verdict": "failed"}])
    assert found["wind.speed"] == found["material.E"] == 1
    assert found["wind.azimuth"] == 0
    assert found["all"] == pytest.approx(2 / 3)
    assert found["films"] == 1


def test_a_fit_of_a_film_is_recorded(monkeypatch):
    monkeypatch.setattr(fit_films, "UNTIL", 0.3)
    monkeypatch.setattr(fit_films, "TRACKS", 40)
    options = ("--parts", "coverage", "--kinds", "banner", "--films", "1")
    result, _ = measure("fit_films", *options, result=json.loads(json.dumps(HEAD)))
    assert list(result["coverage"]) == ["banner 0"]
    (row,) = result["coverage"].values()
    assert set(row["errors"]) == set(row["standard_errors"]) == {"wind.speed", "wind.azimuth", "material.E"}
    assert min(row["standard_errors"].values()) > 0
    assert row["verdict"] in ("good", "doubtful", "failed")


def test_independent_films_have_numbers_and_rows_of_their_own(monkeypatch):
    """Each is another film, and all are measured in processes."""
    asked = []
    monkeypatch.setattr(fit_films, "apart", lambda count, works: asked.append(count) or works)
    options = SimpleNamespace(parts=fit_films.PARTS, kinds=["post"], first=0, films=2, independent=False, processes=1)
    tuned = dict(fit_films.rows(options, {}))
    assert not asked
    options.independent, options.processes = True, 3
    new = dict(fit_films.rows(options, {}))
    assert asked == [3]
    assert ("coverage", "post 1") in tuned
    assert ("independent_coverage", "post 201") in new
    assert ("independent_verdicts", "post 200, from this start alone") in new
    films = [work.args[0] for works in (tuned, new) for (part, _), work in works.items() if "coverage" in part]
    assert len({film.speed for film in films}) == 4


def test_what_the_page_shows():
    """A fit that misses by more than twice the goals is named, one that was refused has no numbers."""
    row = {"errors": {"wind.speed": 0.04, "wind.azimuth": -12.0, "material.E": 0.1}, "processor_s": 30.0}
    row["standard_errors"] = {"wind.speed": 0.03, "wind.azimuth": 1.0, "material.E": 0.2}
    row |= {"verdict": "doubtful", "further": {"film.start": [-0.2, 0.01]}, "gain_at_the_end": 1.7, "true_gain": 1.67}
    refused = {"verdict": "failed", "why": ["No."], "processor_s": 3.0}
    record = json.loads(json.dumps(HEAD))
    record |= {part: {"banner 0": row} for part in ("starts", "winds", "coverage")}
    fine = row | {"errors": dict.fromkeys(row["errors"], 0.0), "verdict": "good"}
    record["verdicts"] = {"banner 0": row, "banner 1": fine, "post 0": refused}
    record["independent_verdicts"] = {"post 200, from this start alone": row | {"verdict": "good"}}
    assert cells("fit.verdicts", record) == [
        ["banner", "0 to 199", "2", "1", "1", "1", "0", "0", "30 s"],
        ["post", "0 to 199", "1", "0", "0", "0", "1", "0", "3 s"],
        ["post, from this start alone", "from 200", "1", "0", "1", "0", "0", "1", "30 s"],
    ]
    assert cells("fit.missed", record) == [
        ["banner 0", "+4.0 %", "-12.0°", "+10.0 %", "doubtful", "yes"],
        ["post 0", "", "", "", "failed", "yes"],
        ["post 200, from this start alone", "+4.0 %", "-12.0°", "+10.0 %", "good", "yes"],
    ]
    assert cells("fit.starts", record) == [["banner 0", "+4.0 %", "-12.0°", "+10.0 %", "-0.20 s", "doubtful"]]
    record["scales"] = {"banner": row | {"further": {"scene.metres_per_unit": [0.994, 0.01]}}}
    assert cells("fit.scales", record) == [["banner", "+4.0 %", "-12.0°", "+10.0 %", "0.994 m", "0.010 m", "doubtful"]]
    spectrum = {"mean": [3.0, 2.7, 3.4], "intensity": [0.2, 0.1, 0.4], "time_scale": [0.6, 0.3, 3.0], "told": False}
    record["gusts"] = {"banner": row | {"gusts": spectrum, "true_mean": 3.1}, "post": refused}
    assert cells("fit.gusts", record) == [
        ["banner", "3 (2.7 to 3.4)", "3.10", "0.2 (0.1 to 0.4)", "0.6 (0.3 to 3)", "no", "doubtful"],
        ["post", "", "", "", "", "no", "failed"],
    ]
    assert cells("fit.winds", record) == [["banner 0", "+4.0 %", "-12.0°", "+10.0 %", "1.70", "1.67", "doubtful"]]
    record["independent_coverage"] = {"banner 200": fine}
    assert cells("fit.coverage", record) == [
        ["0 to 199", "1", "100 %", "0 %", "100 %", "67 %"],
        ["from 200", "1", "100 %", "100 %", "100 %", "100 %"],
    ]
