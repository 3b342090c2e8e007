"""CONTRIBUTING.md and the files for GitHub name what exists."""

import re
import shlex
from pathlib import Path

import yaml

import gaussian_swaying

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
CODE = re.findall(r"`([^`\n]+)`", TEXT)


def test_files_that_are_named_exist():
    named = [c for c in CODE if re.fullmatch(r"[\w./-]+\.(py|md|pyi)|[\w.-]+/([\w./-]+)?|\.ci/\w+", c)]
    links = re.findall(r"\]\((?!http)([^)#]+)", TEXT)
    assert len(named) > 12
    assert len(links) > 2
    homes = (ROOT, ROOT / "gaussian_swaying")
    assert [name for name in {*named, *links} if not any((home / name).exists() for home in homes)] == []


def test_commands_name_folders_of_tests_that_exist():
    commands = [shlex.split(part) for c in CODE for part in c.split("&&") if part.strip().startswith("pytest ")]
    paths = [word for command in commands for word in command if word.startswith("tests/")]
    assert len(paths) > 5
    assert all((ROOT / path).exists() for path in paths)


def test_base_classes_that_are_named_exist():
    rows = re.findall(r"^\| [^|]+ \| `(\w+)`, (?:a file in )?`([\w./]+)`", TEXT, re.MULTILINE)
    assert {"WindEffect", "SpatialWind", "Force", "ConstitutiveLaw", "Boundary"} == {name for name, _ in rows}
    for name, place in rows:
        home = ROOT / "gaussian_swaying" / place
        files = [home] if home.is_file() else home.glob("*.py")
        assert any(re.search(rf"^class {name}\b", file.read_text("utf-8"), re.MULTILINE) for file in files), name


def test_the_citation_has_the_version_and_the_licence_of_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    assert citation["version"] == gaussian_swaying.__version__
    assert f'license = "{citation["license"]}"' in project


def test_workflows_call_the_gate():
    jobs = {
        path.stem: yaml.safe_load(path.read_text("utf-8"))["jobs"]
        for path in (ROOT / ".github" / "workflows").glob("*.yml")
    }
    steps = {name: [s.get("run") for job in each.values() for s in job["steps"]] for name, each in jobs.items()}
    assert ".ci/run" in steps["gate"]
    assert ".ci/nightly" in steps["nightly"]
    others = next(run for run in steps["gate"] if run and run.startswith("pytest"))
    assert all((ROOT / word).exists() for word in others.split()[1:])
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"][0]["hooks"]
    assert {"ruff", "ruff-format", "mypy", "words"} == {hook["id"] for hook in hooks}
