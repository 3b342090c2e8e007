import os
import re
import subprocess
import sys
import warnings
from argparse import ArgumentError
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import refused

from gaussian_swaying.cli.errors import guessing, parser_sentence, run_command, sentence
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.simulation.simulation import Simulation

ROOT = Path(__file__).parents[2]


def raising(error):
    def command():
        raise error

    return command


def caught(function):
    try:
        function()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def nested(depth=100_000):
    return nested(depth - 1) if depth else 0


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (lambda: torch.empty(1 << 62), ["There is not enough memory", "coarser grid"]),
        (lambda: torch.empty(1 << 45), ["There is not enough memory (", "were requested", "coarser grid"]),
        (lambda: torch.empty(1 << 31, 1 << 31, 1 << 31), ["There is not enough memory", "coarser grid"]),
        (lambda: np.empty(1 << 50), ["There is not enough memory (Unable to allocate", "coarser grid"]),
        (lambda: float(10**400), ["A number is too large", "check the given values"]),
        (lambda: torch.tensor([0.0]).fill_(1e300), ["A number is too large", "check the given values"]),
        (lambda: b"\xff\xfe".decode(), ["not UTF-8", "save it as UTF-8"]),
        (nested, ["nested too deeply"]),
        (Path("/nowhere/at/all").read_bytes, ["/nowhere/at/all does not exist", "check the path"]),
        (Path("/").read_bytes, ["/ cannot be used", "directory"]),
        (lambda: os.write(os.open("/dev/full", os.O_WRONLY), b"x"), ["could not be written", "make room"]),
    ],
    ids=["count", "memory", "product", "numpy", "float", "fill", "text", "depth", "missing", "folder", "full"],
)
def test_what_input_and_machine_cause_is_a_sentence(error, words, capsys):
    error = caught(error)
    refused(lambda command: run_command(command, memory="a coarser grid"), raising(error), capsys, *words)


def test_a_bug_is_called_one(capsys, monkeypatch):
    assert run_command(lambda: parser_sentence(None)) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: AttributeError: 'NoneType'")
    assert "bug in gaussian_swaying: please report it" in said
    assert "Traceback" not in said
    assert sentence(AttributeError("no such thing")) is None
    monkeypatch.setenv("GAUSSIAN_SWAYING_DEBUG", "1")
    with pytest.raises(KeyError):
        run_command(raising(KeyError("colour")))


@pytest.mark.parametrize("fault", [lambda: {}["colour"], lambda: torch.ones(3) + torch.ones(2)])
def test_an_error_in_a_file_of_the_user_names_its_line(fault, capsys):
    """Such as that of an effect, although the package called it; torch's own frames and lines do not count."""
    assert run_command(fault) == 1
    said = capsys.readouterr().err
    assert f"raised in {__file__}, line {fault.__code__.co_firstlineno}: correct it there" in said
    assert "report" not in said


def test_codes_and_what_is_said(capsys):
    assert run_command(lambda: None) == 0
    assert run_command(lambda: 130) == 130
    assert run_command(raising(KeyboardInterrupt()), stopped="Stopped here.") == 130
    assert capsys.readouterr().err == "Stopped here.\n"
    assert run_command(raising(StopIteration("here")), expected=(StopIteration,)) == 2
    assert run_command(raising(ArgumentError(None, "no such option"))) == 2
    assert "no such option; --help lists the options." in capsys.readouterr().err
    run_command(raising(ArgumentError(None, "No such option: leave it out.")))
    assert "leave it out; --help lists the options." in capsys.readouterr().err


def test_a_warning_is_one_line_and_said_once(capsys):
    def command():
        for _ in range(2):
            warnings.warn("the splat is odd", UserWarning, stacklevel=1)
            warnings.warn_explicit("the splat is odd", UserWarning, "elsewhere.py", 3)

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run_command(command) == 0
    assert capsys.readouterr().err == "warning: the splat is odd\n"


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled")
def test_kernels_that_were_compiled_are_told_once_on_standard_error(tmp_path, monkeypatch, capsys):
    assert compiles("cpu")
    monkeypatch.setenv("GAUSSIAN_SWAYING_CACHE", str(tmp_path))
    monkeypatch.setattr(cpu, "_COMPILED", {})
    monkeypatch.setattr(cpu, "_spent", [0, 0.0, 0.0])

    def command():
        deform_all(*torch.ones(2, 1, 3, 3), torch.ones(1, 3), rotations=False)

    for _ in range(2):
        assert run_command(command) == 0
    told = capsys.readouterr()
    assert told.out == ""
    assert re.fullmatch(
        rf"note: Compiled 1 kernel for this CPU in \d+\.\d s, once \(kept in {tmp_path}\)\.\n", told.err
    )
    assert [path.suffix for path in tmp_path.iterdir()] == [".o"]


# ---- guesses


@pytest.mark.parametrize(
    ("arguments", "guess"),
    [
        (["--wind.flwo", "3"], "(did you mean --wind.flow?)"),
        (["--frmes", "3"], "(did you mean --frames?)"),
        (["--config", "{wind: {flwo: 3}}"], "(did you mean wind.flow?)"),
        (["--config", "{wnd: {flow: 3}}"], "(did you mean wind.flow?)"),
        (["--camera", "{class_path: OrbitCamera, init_args: {radus: 3}}"], "(did you mean radius?)"),
    ],
)
def test_a_misspelt_option_is_guessed(arguments, guess):
    parser = Simulation.parser()
    with pytest.raises(ArgumentError, match="did you mean") as caught, guessing(parser):
        parser.parse_args(arguments)
    assert guess in str(caught.value)


def test_the_page_tells_how_to_complete(tmp_path):
    page = (ROOT / "docs/command_line.md").read_text(encoding="utf-8")
    line = next(line for line in page.splitlines() if line.startswith("complete "))
    name = "gaussian-swaying"
    line = line.replace(f"$({name} sim", f"$({sys.executable} {ROOT / 'tools/sim.py'}")
    script = f'{line}\ncompgen -W "$(complete -p {name} | sed "s/.*-W \'//; s/\' {name}//")" -- --wind.'
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert "--wind.flow" in done.stdout.split()
    assert "--wind.modulations" in done.stdout.split()
