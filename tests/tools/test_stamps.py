"""When, and from which code, each row of a record was measured."""

import hashlib
import json
import subprocess
from pathlib import Path

import pytest
from bench import record, stamps
from bench.case import Case
from bench.tables import measured
from bench.tables.markdown import source

from .conftest import shown

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.fixture
def clock(monkeypatch):
    """Sets what is now: a date, a commit, and the hash of all code."""

    def set_to(date, sources="a"):
        told = {"date": date, "commit": f"commit of {date}", "clean": True, "versions": {"torch": "2"}}
        monkeypatch.setattr(stamps, "now", lambda: told)
        monkeypatch.setattr(stamps, "sources", lambda part: f"{part} {sources}")

    return set_to


@pytest.mark.parametrize("path", [path for path in sorted(RESULTS.glob("*.json")) if path.name != record.AGES],
                         ids=lambda path: path.stem)  # fmt: skip
def test_every_recorded_row_has_one_stamp(path):
    result = json.loads(path.read_text())
    places = [place for place, _ in stamps.rows(result)]
    assert places
    assert sorted(stamps.stamp_of(result)) == sorted(places)
    assert sorted(place for stamp in result["measured"].values() for place in stamp["rows"]) == sorted(places)
    assert path.stem.startswith(tuple(stamps.PARTS))
    for stamp in result["measured"].values():
        assert len(stamp["date"]) == len("2026-11-23 00:00:00")
        assert stamp["commit"]
        assert stamp["versions"]
        assert stamp["clean"] in (True, False) or stamp["from_history"]
        assert bool(stamp["sources"]) == bool(stamps.parts_of(path.stem))  # of the rooms that there were then


def test_the_file_of_ages_names_stamps_that_are_there():
    records = record.read(RESULTS)
    for name, found in json.loads((RESULTS / record.AGES).read_text()).items():
        for key, parts in found.items():
            assert key in records[name]["measured"]
            assert set(parts) <= set(stamps.parts_of(name))


def test_rows_kept_from_before_keep_their_stamps(tmp_path, clock):
    clock("monday")
    record.write(
        tmp_path, "accuracy_cpu", {"rows": [{"problem": "bar", "x": 1}, {"problem": "sand", "x": 2}]}, quiet=True
    )
    clock("tuesday", "b")

    def anew(result, save):
        def rows(options, found):
            found["rows"] = [row for row in found["rows"] if row["problem"] == "sand"]
            yield ("rows", {"problem": "bar"}), {"x": 1}.copy  # the same result

        Case("", rows).measure(None, result, save)

    record.go_on(tmp_path, "accuracy_cpu", {"device": "another"}, anew, keeps="any")
    found = record.read(tmp_path)["accuracy_cpu"]
    assert stamps.stamp_of(found) == {"rows/0": "monday", "rows/1": "tuesday"}
    assert found["measured"]["monday"]["sources"]["mpm"] == "mpm a"
    found["rows"][0]["x"] = 3  # by hand
    assert stamps.stamp_of(found) == {"rows/1": "tuesday"}


def test_rows_of_a_table_keep_their_stamps_too(tmp_path, clock):
    """Those of a row that another process measured meanwhile, too; rows without a stamp get none of today's."""
    before = {"device": "a", "rows": {"ours": {"1": {"x": 1}, "2": {"x": 2}}, "particle": {"1": {"x": 5}}}}
    (tmp_path / "flags_cpu.json").write_text(json.dumps(before))
    clock("monday")

    def one(result, save):
        result["rows"]["ours"]["1"] = {"x": 3}
        save(result)

    record.go_on(tmp_path, "flags_cpu", {"device": "a"}, one)
    clock("tuesday")

    def two(result, save):
        record.go_on(tmp_path, "flags_cpu", {"device": "a"}, one)
        result["rows"]["ours"]["2"] = {"x": 4}
        save(result)

    record.go_on(tmp_path, "flags_cpu", {"device": "a"}, two)
    found = json.loads((tmp_path / "flags_cpu.json").read_text())
    assert stamps.stamp_of(found) == {"rows/ours/1": "monday", "rows/ours/2": "tuesday", "rows/particle/1": "unknown"}
    assert found["measured"]["unknown"]["date"] is None


def test_rows_older_than_their_code_are_marked(tmp_path, clock):
    head = {"device": "a GPU", "versions": {"torch": "2"}, "seed": 0}
    rows = {"ours": {"1": {"x": 1}}, "particle": {"1": {"x": 2}}}
    clock("2026-11-22 10:00:00")
    record.write(tmp_path, "winds_cpu", head | {"rows": {"ours": rows["ours"]}}, quiet=True)
    clock("2026-11-23 10:00:00", "b")
    old = json.loads((tmp_path / "winds_cpu.json").read_text())
    record.write(tmp_path, "winds_cpu", old | {"rows": rows}, quiet=True)
    line = source(record.read(tmp_path)["winds_cpu"])
    assert line == "a GPU; torch 2; seed 0. Measured from 2026-11-22 to 2026-11-23."
    ages = stamps.ages(record.read(tmp_path))
    assert ages == {"winds_cpu": {"2026-11-22 10:00:00": ["mpm", "geometry", "aero"]}}
    (tmp_path / record.AGES).write_text(json.dumps(ages))
    found = record.read(tmp_path)["winds_cpu"]
    assert "1 of 2 rows [before the last change](benchmarks.md#when-it-was-measured) of aero, geometry" in source(found)
    told = shown("measured.rows", [found])[2:]
    assert told[0].startswith("| winds_cpu | ours: 1 | 2026-11-22 10:00:00 | commit  | clean | torch 2 | mpm, geometry")
    assert told[1].startswith("| winds_cpu | particle: 1 | 2026-11-23 10:00:00 |")
    assert told[1].endswith("| torch 2 | - |")


def test_rows_of_lists_are_counted():
    result = {"rows": [{"problem": "bar"}, {"problem": "bar"}, {"problem": "sand"}], "fit": {"x": 1}}
    places = dict.fromkeys([place for place, _ in stamps.rows(result)], "")
    assert measured.labels(result, places) == "bar (2); sand; fit"


def test_code_is_hashed_as_git_does(tmp_path, monkeypatch):
    """By the names that it gives to contents, whatever ends a line; other files than Python's do not count."""
    monkeypatch.setattr(stamps, "ROOT", tmp_path)
    code = tmp_path / "gaussian_swaying" / "mpm"
    code.mkdir(parents=True)
    hashes = []
    for number, text in enumerate((b"A = 1\r\n", b"A = 1\n", b"A = 2\n")):
        (code / "a.py").write_bytes(text)
        (code / "a.txt").write_text(str(number))
        stamps.sources.cache_clear()
        hashes.append(stamps.sources("mpm"))
    stamps.sources.cache_clear()
    blob = subprocess.run(["git", "hash-object", "--stdin"], input=b"A = 2\n", capture_output=True, check=True).stdout
    said = f"gaussian_swaying/mpm/a.py {blob.decode().strip()}"
    assert hashes[0] == hashes[1]
    assert hashes[2] == hashlib.sha256(said.encode()).hexdigest()[:16]


def test_what_is_known_without_a_history(monkeypatch):
    stamps.now.cache_clear()
    monkeypatch.setenv("BENCH_COMMIT", "abc1234-dirty")
    told = stamps.now()
    stamps.now.cache_clear()
    assert (told["commit"], told["clean"]) == ("abc1234", False)
    assert "torch" in told["versions"]
