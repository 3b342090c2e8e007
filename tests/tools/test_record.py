"""Records that several processes write."""

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
    def other(result, save):
        save(result | {"rows": {"two": {"1": {"x": 2}}}})

    def measure(result, save):
        record.go_on(tmp_path, "flags_cpu", {"device": "a"}, other)
        save(result | {"rows": {"one": {"1": {"x": 1}}}})

    record.go_on(tmp_path, "flags_cpu", {"device": "a"}, measure)
    found = json.loads((tmp_path / "flags_cpu.json").read_text())
    assert found["rows"] == {"one": {"1": {"x": 1}}, "two": {"1": {"x": 2}}}
    assert [path.name for path in tmp_path.iterdir()] == ["flags_cpu.json"]
    record.go_on(tmp_path, "flags_cpu", {"device": "b"}, lambda result, save: save(result))
    assert json.loads((tmp_path / "flags_cpu.json").read_text()) == {"device": "b"}
    for keeps, rows in (("none", 1), ("device", 1), ("any", 2)):
        old = {"device": "a", "rows": {"old": {"x": 1}}}
        record.write(tmp_path, "live_cpu", old, quiet=True)
        put = lambda result, save: save(result | {"rows": result.get("rows", {}) | {"new": {"x": 2}}})  # noqa: E731
        record.go_on(tmp_path, "live_cpu", {"device": "b"}, put, keeps)
        assert len(json.loads((tmp_path / "live_cpu.json").read_text())["rows"]) == rows


def test_rows_that_are_all_measured_anew_with_the_same_results_are_all_kept(tmp_path):
    rows = [{"x": 1}, {"x": 2}]
    record.write(tmp_path, "accuracy_cpu", {"device": "a", "rows": rows}, quiet=True)

    def anew(result, save):
        result["rows"] = []
        for row in rows:
            result["rows"].append(row)
            save(result)

    record.go_on(tmp_path, "accuracy_cpu", {"device": "a"}, anew)
    assert json.loads((tmp_path / "accuracy_cpu.json").read_text())["rows"] == rows


def test_a_row_that_another_process_measures_anew_is_not_put_back(tmp_path):
    """Each process holds the rows that it read at its start, and writes only those that it changed."""
    old = {"device": "a", "note": "Old.", "rows": {"one": {"1": {"x": 1}, "2": {"x": 1}}, "two": {"1": {"x": 1}}}}
    record.write(tmp_path, "flags_cpu", old, quiet=True)

    def measure(result, save):
        def other(rows, keep):
            rows["rows"]["two"]["1"] = {"x": 2}
            rows["rows"]["one"]["2"] = {"x": 2}
            keep(rows | {"note": "New."})

        record.go_on(tmp_path, "flags_cpu", {"device": "a"}, other)
        result["rows"]["one"]["1"] = {"y": 3}
        save(result)

    record.go_on(tmp_path, "flags_cpu", {"device": "a"}, measure)
    found = json.loads((tmp_path / "flags_cpu.json").read_text())
    assert found["rows"] == {"one": {"1": {"y": 3}, "2": {"x": 2}}, "two": {"1": {"x": 2}}}
    assert found["note"] == "New."


def test_rows_of_a_list_are_kept_from_both_processes(tmp_path):
    record.write(tmp_path, "nature_cpu", {"device": "a", "rows": [{"x": 1}, {"x": 2}, {"x": 3}]}, quiet=True)

    def measure(result, save):
        def other(rows, keep):
            keep(rows | {"rows": [{"x": 2}, {"x": 3}, {"x": 10}]})

        record.go_on(tmp_path, "nature_cpu", {"device": "a"}, other)
        save(result | {"rows": [{"x": 1}, {"x": 2}, {"x": 30}]})

    record.go_on(tmp_path, "nature_cpu", {"device": "a"}, measure)
    assert json.loads((tmp_path / "nature_cpu.json").read_text())["rows"] == [{"x": 2}, {"x": 30}, {"x": 10}]
