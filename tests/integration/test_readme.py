import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
RESULTS = ROOT / "docs" / "results"


def test_every_file_that_the_readme_names_exists():
    named = re.findall(r"\]\((?!https?://)([^)#]+)[^)]*\)", README)
    named += re.findall(r"(?<![\w/])((?:docs|configs|tools)/[\w/.]+\.\w+)", README)
    assert len(named) > 15
    assert len(README.splitlines()) <= 100  # it shows; the pages argue
    for name in named:
        assert (ROOT / name).exists(), name


def test_every_page_is_linked_and_every_link_leads_somewhere():
    pages = sorted((ROOT / "docs").glob("*.md"))
    texts = {page: page.read_text() for page in [*pages, ROOT / "README.md"]}
    for page, text in texts.items():
        for name in re.findall(r"\]\((?!https?://|#)([^)#]+)[^)]*\)", text):
            assert (page.parent / name).exists(), f"{page.name}: {name}"
    for page in pages:
        assert any(page.name in text for other, text in texts.items() if other != page), f"{page.name} is not linked"


def test_the_package_index_gets_no_link_to_a_file_beside_the_readme():
    project = pytest.importorskip("tomllib").loads((ROOT / "pyproject.toml").read_text())
    text = README
    for change in project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    assert re.findall(r"\]\((?!https?://)[^)]*\)", text) == []
    assert "docs/own_scene.md explains each guess" in text
    assert "[PhysGaussian](https://github.com/" in text


def _recorded(device, name):
    lines = [json.loads(line) for line in (RESULTS / "runs.jsonl").read_text().splitlines()]
    own = [line for line in lines if device.lower() in line["device"].lower() and name in line["parameters"]["name"]]
    return own[-1]["numbers"]


def test_output_of_the_first_command_is_the_recorded_one():
    row = _recorded("cpu", "flag")
    seconds = ", ".join(f"{part} {value:.1f} s" for part, value in row["wall_s"].items())
    assert f"{row['frames']} frames, {row['substeps']:,} substeps: {seconds}\n" in README
    assert "The run takes some ten seconds" in README
    assert 5 < row["process_wall_s"] < 20


def test_the_guitar_moves_faster_than_real_time_on_a_gpu():
    row = _recorded("NVIDIA", "guitar")
    assert row["simulated_gaussians"] == 90_854
    assert sum(value for part, value in row["wall_s"].items() if part != "startup") < 0.04 * row["frames"]
