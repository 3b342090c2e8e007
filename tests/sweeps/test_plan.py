from argparse import ArgumentError
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from shared import value_error

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.sweeps import plan as plan_module
from gaussian_swaying.sweeps.plan import make_plan, parse_run, read_sweep

ROOT = Path(__file__).parents[2]


def test_a_plan(tmp_path, sweep_file, parser):
    plan = read_sweep(sweep_file(tmp_path / "a.yaml"), parser=parser)
    assert plan.names == [f"{number:05d}" for number in range(8)]
    assert list(plan.runs[0]) == ["wind.flow", "material.E", "wind.seed"]
    assert plan.frames == 12
    assert plan.splats == {}
    settings = parse_run(parser, plan.config, plan.frames, plan.runs[7])
    assert settings.wind.flow == [8.0, 2.0, 0.0]
    assert settings.material.E == 3e4
    assert settings.wind.seed == plan.runs[7]["wind.seed"]
    assert settings.solver.dx == 0.2  # of the settings
    assert settings.aero.C_F == 0.3  # of the base
    assert settings.frames == 12


def test_frames_can_be_an_axis(tmp_path, sweep_file, parser):
    plan = read_sweep(sweep_file(tmp_path / "a.yaml", {"material.E": [1e3], "wind.seed": [3]}, 1), parser=parser)
    assert parse_run(parser, plan.config, plan.frames, {"frames": 5}).frames == 5


def test_splats_are_remembered_by_their_content(tmp_path, sweep_file, parser):
    write_ply(tmp_path / "one.ply", FlagScene(spacing=0.2).generate())
    write_ply(tmp_path / "two.ply", FlagScene(spacing=0.3).generate())
    axes = {"scene.ply": [str(tmp_path / "one.ply"), str(tmp_path / "two.ply")]}
    plan = read_sweep(sweep_file(tmp_path / "a.yaml", axes, 1), parser=parser)
    assert set(plan.splats) == set(axes["scene.ply"])
    assert len(set(plan.splats.values())) == 2


@pytest.mark.parametrize(
    ("runs", "seeds", "checked"),
    [
        (100, 100, range(100)),  # every value
        (101, 101, (0, 40, 80)),  # of a number in each of so many runs, the first
        (102, 101, range(101)),  # the last run has the number of the first
    ],
)
def test_every_value_is_checked_but_not_hundreds_of_seeds(parser, monkeypatch, runs, seeds, checked):
    told = []

    def parse(parser, config, frames, run):
        told.append(run)
        return SimpleNamespace(scene=SimpleNamespace(ply=None))

    monkeypatch.setattr(plan_module, "parse_run", parse)
    values = [{"material.E": 1e3 * (1 + k // 40), "wind.seed": k % seeds} for k in range(runs)]
    make_plan([], values, {}, parser)
    assert told == [values[k] for k in checked]


@pytest.mark.parametrize("file", sorted((ROOT / "configs/sweep").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_sweeps_are_valid(file, parser):
    plan = read_sweep(file, lambda name: str(ROOT / "configs/sim" / f"{name}.yaml"), parser)
    assert len(plan.runs) > 1


def test_the_sweep_of_the_page(tmp_path, parser):
    (tmp_path / "page.yaml").write_text((ROOT / "docs/many.md").read_text().split("```yaml\n")[1].split("```")[0])
    plan = read_sweep(tmp_path / "page.yaml", lambda name: str(ROOT / "configs/sim" / f"{name}.yaml"), parser)
    assert len(plan.runs) == 30


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"base": None}, ("`base`", "such as flag")),
        ({"axes": {}}, ("`axes`", "add it")),
        ({"axes": [1]}, ("`axes`", "wind.flow")),
        ({"axis": {}}, ("unknown field `axis`", "axes")),
        ({"draws": 0}, ("`draws`", "at least 1")),
        ({"draws": "many"}, ("`draws`", "'many'")),
        ({"seed": 1.5}, ("`seed`", "1.5")),
        ({"settings": {"wind.seed": 3}}, ("`wind.seed`", "`axes`", "remove one")),
        ({"axes": {"--wind.seed": [1]}}, ("`axes`", "--wind.seed", "dashes")),
        ({"axes": {"output": ["a"]}}, ("`axes`", "`output`", "remove it")),
        ({"axes": {"wind.seed": [float("nan")]}}, ("`axes`", "no number")),
    ],
)
def test_bad_sweep_files(tmp_path, sweep_file, change, words):
    path = sweep_file(tmp_path / "a.yaml")
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change, sort_keys=False))
    with value_error("`") as error:
        read_sweep(path)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["axes: [", "- 1", "", "just text"])
def test_files_that_are_no_sweep(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with value_error(r"a\.yaml"):
        read_sweep(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"material.E": [1e3, 2e3, "stiff"]}, ("Run 00002 (material.E: stiff)", "material.E")),
        ({"frames": [3, 0]}, ("Run 00001", "`frames`")),
    ],
)
def test_values_that_sim_does_not_accept(parser, axes, words):
    runs = [dict(zip(axes, values, strict=True)) for values in zip(*axes.values(), strict=True)]
    with pytest.raises((ValueError, ArgumentError)) as error:
        make_plan([str(ROOT / "configs/sim/flag.yaml")], runs, {}, parser)
    for word in words:
        assert word in str(error.value)
