import json
from pathlib import Path

import pytest
from bench import report, runner, studies

ROOT = Path(__file__).parents[2]


@pytest.fixture
def added(monkeypatch):
    monkeypatch.setattr(runner, "STUDIES", {})

    @runner.study("halves", lambda device: [{"number": n, "on": device} for n in (0, 2, 3)])
    def halve(number, on, device):
        assert on == device
        return {"half": number / 2, "inverse": 1 / number}

    return "halves"


def test_a_run_adds_a_line_and_the_last_one_counts(added, tmp_path):
    runner.run(added, folder=tmp_path)
    runner.run(added, only='"number": 2', folder=tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "halves.jsonl").read_text().splitlines()]
    assert [line["parameters"]["number"] for line in lines] == [0, 2, 3, 2]
    assert lines[0]["numbers"] == {"failed": "ZeroDivisionError: division by zero"}
    assert set(lines[1]) == {"commit", "date", "device", "versions", "parameters", "numbers"}
    assert [run.number for run in runner.read(added, tmp_path)] == [0, 2, 3]


def test_a_section_is_made_from_records(added, tmp_path, monkeypatch):
    runner.run(added, folder=tmp_path)
    monkeypatch.setattr(report, "SECTIONS", {})
    monkeypatch.setattr(report, "read", lambda name: runner.read(name, tmp_path))
    report.table("a.halves", added, "number | half", lambda run: f"{run.number} | {run.half:.1f}")
    page = tmp_path / "page.md"
    page.write_text("Before\n<!-- begin: a.halves -->\nold\n<!-- end -->\nAfter\n")
    assert report.report(check=True, folder=tmp_path) == ["page.md"]
    assert report.report(folder=tmp_path) == ["page.md"]
    assert report.report(check=True, folder=tmp_path) == []
    lines = page.read_text().splitlines()
    assert lines[3:7] == ["| number | half |", "|---|---|", "| 2 | 1.0 |", "| 3 | 1.5 |"]
    assert "CPU" in lines[8]
    assert "commit" in lines[8]


def test_the_pages_say_what_is_recorded():
    studies.load()
    assert report.report(check=True) == []
    used = (ROOT / "docs").glob("*.md")
    pages = "".join(page.read_text(encoding="utf-8") for page in used)
    assert [name for name in report.SECTIONS if f"<!-- begin: {name} -->" not in pages] == []


@pytest.mark.slow
def test_studies_run_at_their_smallest():
    studies.load()
    small = {
        "substep": {"case": "substep", "asked": 400},
        "batches": {"case": "batch", "formulation": "total", "gusts": True},
        "contact": {"asked": 400, "case": "all in contact"},
        "backward": {"asked": 400, "by": "auto", "steps": 8},
        "frames": {"case": "frame", "dx_m": 0.1},
    }
    for name, parameters in small.items():
        numbers = runner.STUDIES[name].function(**parameters, device="cpu")
        assert all(value >= 0 for value in numbers.values() if isinstance(value, float)), name
    error = runner.STUDIES["convergence"].function("hanging bar (tip)", "total", 8)["error"]
    assert runner.STUDIES["pareto"].function("bar", 16, "total", 0.4, "cpu")["error"] < 0.01
    assert error < 0.0026  # 1 / (8 cells²)
