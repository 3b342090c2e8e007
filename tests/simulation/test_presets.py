"""``--preset``: the file of the same name beside a configuration."""

from pathlib import Path

import pytest
from shared import refused

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.simulation.simulation import Simulation

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "sim"


@pytest.mark.parametrize("path", sorted((CONFIGS / "preview").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_preset_is_reached(path):
    config = str(CONFIGS / path.name)
    parser = Simulation.parser()
    short = parser.parse_args(["--config", config, "--preset", "preview"])
    long = parser.parse_args(["--config", config, "--config", str(path)])
    full = parser.parse_args(["--config", config])
    for settings in (short, long, full):
        settings.pop("config")
    assert short == long
    assert short.camera.init_args.width < full.camera.init_args.width


def test_options_after_a_preset_override_it():
    given = ["--config", str(CONFIGS / "flag2.yaml"), "--preset", "preview", "--solver.dx", "0.123"]
    assert Simulation.parser().parse_args(given).solver.dx == 0.123


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--preset", "preview"], "Expected --config before --preset"),
        (["--config", str(CONFIGS / "flag2.yaml"), "--preset", "nope"], "available: preview"),
        (["--config", str(CONFIGS / "flag.yaml"), "--preset", "preview"], "leave out --preset"),
    ],
)
def test_a_preset_that_is_not_there(arguments, words, capsys):
    refused(main, arguments, capsys, words)
