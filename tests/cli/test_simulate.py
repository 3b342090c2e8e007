import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from shared import SMALL, refused, words

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.simulation.simulation import Simulation

ROOT = Path(__file__).parents[2]
FLAG = ROOT / "configs/sim/flag.yaml"

RUN = [f"--config={FLAG}", "--frames=2", "--device=cpu", *words(SMALL)]


def _code(arguments):
    try:
        return main(arguments)
    except SystemExit as stop:
        return stop.code


def check_refused(arguments, output, capsys, *told):
    refused(main, [*arguments, "--output", str(output)], capsys, *told, folder=output.parent)


# ---- what works


def test_a_material_that_flows(tmp_path, capsys):
    law = ["--material.law", "Sand", "--material.law.init_args.friction_angle", "35"]
    check_refused([*RUN, *law], tmp_path / "out", capsys, "Sand", "solver.formulation", "updated")
    assert _code([*RUN, *law, "--solver.formulation", "updated", "--output", str(tmp_path / "out")]) == 0
    stored = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert stored["material"]["law"]["init_args"]["friction_angle"] == 35.0


def test_torn_particles_are_warned_of(tmp_path, capsys):
    arguments = [*RUN, "--frames", "6", "--solver.formulation", "updated", "--solver.dx", "0.08"]
    assert _code([*arguments, "--output", str(tmp_path / "out")]) == 0
    assert "particles are farther than two cells from a neighbour" in capsys.readouterr().err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["torn_particles"] > 0
    assert _code([*RUN, "--output", str(tmp_path / "whole")]) == 0
    assert "farther than two cells" not in capsys.readouterr().err


def test_the_tool_as_a_program(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "tools/sim.py"), *RUN, "--material.nu", "0.5"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: Expected `material.nu`")
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_cameras_and_renders_from_a_configuration(tmp_path, capsys):
    """Further cameras by name, a path with keys, and renders beside the colour; the stored configuration keeps them."""
    size = {"width": 16, "height": 8}
    keys = [{"time": 0.0, "azimuth": -70, "elevation": 8, "radius": 2}, {"time": 1.0, "azimuth": -40}]
    side = {"class_path": "OrbitCamera", "init_args": size | {"azimuth": 0.0}}
    cameras = {"side": side, "flight": {"class_path": "LookAtCamera", "init_args": size | {"keys": keys}}}
    more = {"cameras": cameras, "recorder": {"renders": ["color", "normal"]}}
    (tmp_path / "more.yaml").write_text(yaml.safe_dump(more))
    out = tmp_path / "run"
    assert _code([*RUN, "--config", str(tmp_path / "more.yaml"), "--output", str(out)]) == 0
    for name in ("side", "flight"):
        assert (out / "cameras" / name / "frames" / "00001.png").exists()
        assert f"wrote {out / 'cameras' / name / 'normal.mp4'}" in capsys.readouterr().out or name == "flight"
    stored = yaml.safe_load((out / "config.yaml").read_text())
    assert stored["cameras"]["flight"]["init_args"]["keys"][1]["azimuth"] == -40


def test_the_blocks_of_the_page_on_recording_are_configurations(tmp_path):
    blocks = (ROOT / "docs/recording.md").read_text(encoding="utf-8").split("```yaml\n")[1:]
    assert len(blocks) == 4
    parser = Simulation.parser()
    for block in blocks:
        (tmp_path / "block.yaml").write_text(block.split("```")[0])
        parts = parser.instantiate(parser.parse_args(["--config", str(FLAG), "--config", str(tmp_path / "block.yaml")]))
        assert parts.cameras or parts.edits or parts.recorder.renders[1:]


def test_print_config_parses_back(tmp_path, capsys):
    assert _code([*RUN, "--material.E", "1234.5", "--print_config"]) == 0
    printed = capsys.readouterr().out
    assert yaml.safe_load(printed)["material"]["E"] == 1234.5
    (tmp_path / "again.yaml").write_text(printed)
    parser = Simulation.parser()
    first = parser.parse_args([*RUN, "--material.E", "1234.5"])
    second = parser.parse_args(["--config", str(tmp_path / "again.yaml")])
    assert config_text(parser, first) == config_text(parser, second)
    assert second.frames == 2


def _help(capsys, option):
    capsys.readouterr()
    assert _code([option]) == 0
    text = capsys.readouterr().out
    return text, re.findall(r"^ +(?:-h, )?(--[\w.-]+)(?=[ ,\n])", text, flags=re.MULTILINE)


def test_help_shows_the_options_that_people_use(capsys):
    parser = Simulation.parser()
    before = parser.format_help()
    with pytest.raises(SystemExit):
        parser.parse_args(["--help"])
    assert parser.format_help() == before
    (text, common), (whole, every) = _help(capsys, "--help"), _help(capsys, "--help-all")
    assert _help(capsys, "-h") == (text, common)
    assert common[:2] == ["--help", "--help-all"]
    assert len(common) == len(set(common)) == 2 + 21
    needed = {
        "--config",
        "--output",
        "--frames",
        "--scene.ply",
        "--material",
        "--material.E",
        "--wind.flow",
        "--camera",
    }
    assert needed < set(common)
    assert set(common) < set(every)
    assert len(every) > 4 * len(common)
    assert "--recorder.checkpoint_every" not in text
    assert len(text.splitlines()) < 0.25 * len(whole.splitlines())
    assert "--help-all lists all fields" in " ".join(text.split())
    for field in ("scene.max_stretch", "wind.seed", "recorder.checkpoint_every", "dtype"):
        assert f"--{field}" in every, field


@pytest.mark.parametrize(
    ("option", "value", "path"),
    [
        ("--scene.generator.init_args.width", "2.0", "scene.generator.init_args.width"),
        ("--scene.generator.width", "2.0", "scene.generator.init_args.width"),
        ("--solver.formulation", "updated", "solver.formulation"),
        ("--wind.flow", "[1.0, 2.0, 3.0]", "wind.flow"),
        ("--shader", "null", "shader"),
    ],
)
def test_any_field_can_be_overridden(option, value, path):
    settings = Simulation.parser().parse_args(["--config", str(FLAG), option, value])
    assert settings[path] == yaml.safe_load(value)


# ---- bad settings

GUST = '[{"class_path": "SineSway", "init_args": {"amplitud": 1.0}}]'


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scene.bogus", "1"], ["--scene.bogus", "--help"]),
        (["--scene.generator.init_args.spacng", "0.1"], ["spacng", "scene.generator", "--help"]),
        (["--wind.modulations", GUST], ["amplitud", "wind.modulations"]),
        (["--shader.class_path", "NoSuchShader"], ["NoSuchShader"]),
        (
            ["--shader", "null", "--shader.init_args.ambient", "1"],
            ["`shader` has values but no class: put --shader"],
        ),
        (["--frames", "many"], ["frames", "many"]),
        (["--frames", "0"], ["`frames`", "from 1 to"]),
        (["--material.volume", "cube"], ['"material.volume": Expected one of patch, cell']),
    ],
    ids=lambda value: " ".join(value)[:40] if value and value[0].startswith("--") else "",
)
def test_bad_settings(arguments, words, tmp_path, capsys):
    check_refused([*RUN, *arguments], tmp_path / "run", capsys, *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("material:\n  E: 1.0\n  stiffness: 2\n", ["stiffness", "material"]),
        ("material:\n  E: soft\n", ["material.E", "soft"]),
        ("scene: [1\n  b: }\n", ["bad.yaml", "YAML"]),
        ("just a sentence\n", ["config"]),
        ("preset: preview\n", ["`preset`", "command-line", "--preset"]),
    ],
    ids=["nested", "type", "malformed", "sentence", "preset"],
)
def test_bad_configuration_files(text, words, tmp_path, capsys):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    check_refused(["--config", str(path)], tmp_path / "run", capsys, *words)


# ---- a run that goes wrong


def test_a_diverging_run(tmp_path, capsys):
    """Exit code 2, a sentence with time, particle, cause and remedy, and what was recorded is there."""
    code = main([*RUN, "--solver.cfl", "50", "--frames", "20", "--output", str(tmp_path / "run")])
    error = capsys.readouterr().err
    assert code == 2
    assert "Traceback" not in error
    sentence = error[error.index("error: ") :]
    assert "diverged at t = " in sentence
    assert ", particle " in sentence
    assert "Courant number" in sentence
    assert "Remedy: lower `solver.cfl`" in sentence
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["status"] == "diverged"
    assert summary["reason"] in sentence
    assert (tmp_path / "run" / "video.mp4").exists()
