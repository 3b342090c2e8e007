"""The README's examples run, and its first commands are the ones that it promises."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_one_example_for_each_component():
    used = ("GaussianSurfaceModel", "MPMSolver", "AeroForce", "WindLoad", "DiffuseShader")
    assert len(EXAMPLES) == 5
    for name, example in zip(used, EXAMPLES, strict=True):
        assert name in example
        assert len([line for line in example.splitlines() if line.strip()]) <= 14


@pytest.mark.parametrize("example", EXAMPLES, ids=["surface", "solver", "wind", "load", "shading"])
def test_example_runs(example, capsys):
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed
    assert "nan" not in printed


def test_first_two_commands():
    commands = re.findall(r"```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert commands[0] == "pip install -c constraints.txt -e . && python tools/sim.py --config configs/sim/flag.yaml"
    assert commands[1] == 'pip install -c constraints.txt -e ".[dev]" && pytest'


def test_every_file_that_the_readme_names_exists():
    for name in [*re.findall(r"\]\(((?:docs|configs|tools)/[^)]+)\)", README), "configs/sim/hanging_object.yaml"]:
        assert (ROOT / name).exists(), name
