import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from shared import refused

import gaussian_swaying
from gaussian_swaying import _program as program
from gaussian_swaying.cli import shipped
from gaussian_swaying.cli.errors import command
from gaussian_swaying.cli.main import COMMANDS, main
from gaussian_swaying.cli.train import make_cli

ROOT = Path(__file__).parents[2]


def test_what_there_is(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    for name in COMMANDS:
        assert f"\n  {name} " in out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"gaussian-swaying {gaussian_swaying.__version__}\n"
    refused(main, ["exprot"], capsys, "error: There is no command 'exprot' (did you mean export?)")


@pytest.mark.parametrize(
    ("body", "code", "told"),
    [
        ("os.kill(os.getpid(), signal.SIGINT)\nos.getpid()", 130, "Stopped.\n"),
        ("def main(given): os.kill(os.getpid(), signal.SIGINT); os.getpid()", 130, "Stopped.\n"),
        (
            "raise ImportError('lib.so: failed to map segment from shared object')",
            2,
            "error: There is not enough memory",
        ),
        ("raise MemoryError", 2, "error: There is not enough memory to load PyTorch"),
    ],
)
def test_what_ends_a_command_before_it_runs(tmp_path, body, code, told):
    """Ctrl-C and a lack of memory while modules are loaded or options are read; no traceback."""
    (tmp_path / "loads.py").write_text(f"import os, signal\n{body}\n")
    run = "import sys; from gaussian_swaying.cli import main; main.COMMANDS['sim'] = ('loads', ''); main.run()"
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    done = subprocess.run([sys.executable, "-c", run, "sim"], env=env, capture_output=True, text=True)
    assert done.returncode == code
    assert done.stderr.startswith(told)
    assert done.stderr.count("\n") == 1


def test_what_torch_would_not_explain(tmp_path, monkeypatch, capsys):
    """Before it is loaded; no module is needed for the version."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    refused(main, ["export"], capsys, "The working directory no longer exists")
    assert main(["--version"]) == 0


@pytest.mark.parametrize("name", list(COMMANDS))
def test_each_command_has_its_own_help(name, capsys):
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    assert left.value.code in (0, None)
    assert f"gaussian-swaying {name}" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", ["sim", "preview", "eval", "export", "train", "convert_physgaussian"])
def test_each_tool_is_a_program(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"tools/{name}.py", "--help"])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(ROOT / "tools" / f"{name}.py"), run_name="__main__")
    assert left.value.code in (0, None)
    assert capsys.readouterr().out.startswith(f"usage: {name.split('_')[0]}.py")


def test_commands_that_are_printed_can_be_pasted(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["tools/sim.py", "--frames", "3"])
    assert program.words("preview") == ["python", "tools/preview.py"]
    assert command(["--frames", "3"], "--resume") == "python tools/sim.py --frames 3 --resume"
    program.called("sim")
    assert program.words("preview") == ["gaussian-swaying", "preview"]
    assert command(["--frames", "3"], "--resume") == "gaussian-swaying sim --frames 3 --resume"


def test_a_file_comes_before_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flag").write_text("frames: 3\n")
    assert shipped.with_shipped(["--config", "flag", "--frames", "4"], "sim") == ["--config", "flag", "--frames", "4"]
    (tmp_path / "flag").unlink()
    file = str(shipped.folder() / "sim" / "flag.yaml")
    assert shipped.with_shipped(["--config", "flag"], "sim") == ["--config", file]
    assert shipped.with_shipped(["--config", "my/own.yaml"], "sim") == ["--config", "my/own.yaml"]


def test_a_configuration_of_a_training_by_name():
    cli = make_cli(["--config", "quick_cpu"], run=False)
    assert cli.config["trainer"]["max_steps"] < 60_000
    assert "quick_cpu" in shipped.names("train")
