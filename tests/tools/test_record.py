"""Records that several processes write."""

import argparse
import json

from bench import record


def test_rows_are_merged_and_not_what_is_in_them():
    old = {"device": "a", "rows": {"ours": {"1": {"failed": "x"}, "2": {"share": 1.0}}, "thin": {"1": {"share": 3.0}}}}
    new = {"device": "a", "rows": {"ours": {"1": {"share": 2.0}}}, "pair": {"bare": [1]}}
    assert record.merged(old, new) == {
        "device": "a",
        "rows": {"ours": {"1": {"share": 2.0}, "2": {"share": 1.0}}, "thin": {"1": {"share": 3.0}}},
        "pair": {"bare": [1]},
    }


def test_what_another_process_wrote_meanwhile_is_kept(tmp_path):
    options = argparse.Namespace(results=str(tmp_path))

    def measure(_, result, save):
        record.go_on(
            options,
            "flags_cpu",
            {"device": "a"},
            lambda _, other, keep: keep(other | {"rows": {"two": {"1": {"x": 2}}}}),
        )
        save(result | {"rows": {"one": {"1": {"x": 1}}}})

    record.go_on(options, "flags_cpu", {"device": "a"}, measure)
    found = json.loads((tmp_path / "flags_cpu.json").read_text())
    assert found["rows"] == {"one": {"1": {"x": 1}}, "two": {"1": {"x": 2}}}
    assert [path.name for path in tmp_path.iterdir()] == ["flags_cpu.json"]
    record.go_on(options, "flags_cpu", {"device": "b"}, lambda _, result, save: save(result))
    assert json.loads((tmp_path / "flags_cpu.json").read_text()) == {"device": "b"}


def test_a_row_that_another_process_measures_anew_is_not_put_back(tmp_path):
    """Each process holds the rows that it read at its start, and writes only those that it changed."""
    options = argparse.Namespace(results=str(tmp_path))
    old = {"device": "a", "note": "Old.", "rows": {"one": {"1": {"x": 1}, "2": {"x": 1}}, "two": {"1": {"x": 1}}}}
    record.write(tmp_path, "flags_cpu", old, quiet=True)

    def measure(_, result, save):
        def other(_, rows, keep):
            rows["rows"]["two"]["1"] = {"x": 2}
            rows["rows"]["one"]["2"] = {"x": 2}
            keep(rows | {"note": "New."})

        record.go_on(options, "flags_cpu", {"device": "a"}, other)
        result["rows"]["one"]["1"] = {"y": 3}
        save(result)

    record.go_on(options, "flags_cpu", {"device": "a"}, measure)
    found = json.loads((tmp_path / "flags_cpu.json").read_text())
    assert found["rows"] == {"one": {"1": {"y": 3}, "2": {"x": 2}}, "two": {"1": {"x": 2}}}
    assert found["note"] == "New."
