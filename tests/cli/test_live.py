"""``gaussian-swaying live``: what it shows, and its life from the command line."""

import os
import signal
import subprocess
import sys
import urllib.request

import pytest
import torch
from shared import refused, value_error
from small_scenes import run_cost

from gaussian_swaying.cli import live, scene
from gaussian_swaying.cli.preview import main as preview
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.gaussians.formats import export_cloud
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.player.session import settings_of_splat
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.scenes.alocasia import alocasia
from gaussian_swaying.simulation.simulation import Simulation


def test_options_and_scene_come_in_any_order(parser):
    own, port = ["--device", "cpu", "--wind.flow", "[1,-2,3]", "--solver.damping", "-3", "--resume"], ["--port", "9000"]
    for line in (
        ["my.ply", *port, *own, "--no-browser"],
        [*port, *own[:2], "my.ply", "--no-browser", *own[2:]],
        [*own, "--no-browser", "my.ply", "--port=9000"],
    ):
        options, further = live.split(parser, line)
        assert (options.scene, options.port, options.no_browser) == ("my.ply", 9000, True)
        assert further == own


def test_options_of_this_command_are_not_shortened_and_there_is_one_scene(parser):
    options, further = live.split(parser, ["--solver.dx=0.1", "--host", "::1"])
    assert (options.scene, options.host, further) == (None, "::1", ["--solver.dx=0.1"])
    assert live.split(parser, ["--po", "8081"])[1] == ["--po", "8081"]
    with value_error(r"one SCENE, but got a\.ply and b\.ply"):
        live.split(parser, ["a.ply", "--device", "cpu", "b.ply"])


def test_a_configuration_and_a_shipped_one(parser, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("scene: {generator: {class_path: FlagScene}}\nsolver: {dx: 0.3}\n")
    assert scene.settings_of(parser, str(file), [], tmp_path).solver.dx == 0.3
    assert scene.settings_of(parser, None, ["--config", str(file), "--solver.dx=0.4"], tmp_path).solver.dx == 0.4
    folder = tmp_path / "run"
    folder.mkdir()
    file.rename(folder / "config.yaml")
    assert scene.settings_of(parser, str(folder), [], tmp_path).solver.dx == 0.3
    options = ["--preset=preview", "--wind.flow", "-7,0,0"]
    found = scene.settings_of(parser, "two_flags", options, tmp_path)
    assert found.wind.flow == [-7, 0, 0]
    assert config_text(parser, found) == config_text(
        parser, parser.parse_args(with_shipped(["--config=two_flags", *options], "sim"))
    )
    with value_error("`SCENE` and `--config`"):
        scene.settings_of(parser, "my.ply", ["--config", str(file)], tmp_path)


def test_a_splat_gets_what_the_preview_suggests(parser, tmp_path):
    path = tmp_path / "flag.ply"
    write_ply(path, FlagScene(spacing=0.025).generate())
    settings = scene.settings_of(parser, str(path), ["--device=cpu", "--wind.flow=[1,2,3]"], tmp_path)
    assert settings.scene.ply == str(path)
    assert settings.wind.flow == [1, 2, 3]
    quick = settings_of_splat(parser, path, torch.device("cpu"), tmp_path, quick=True)
    assert (settings.solver.dx, quick.solver.dx) == (0.043, 0.062)  # a draft has 16 cells along its 1 m
    simulation = Simulation.from_settings(parser, settings)
    frames = list(simulation.frames(2))
    assert torch.isfinite(frames[-1].state.position).all()


def test_a_plant_in_a_pot_moves_in_it(parser, tmp_path):
    path = tmp_path / "plant.ply"
    write_ply(path, alocasia(spacing=0.005))
    settings = settings_of_splat(parser, path, torch.device("cpu"), tmp_path, quick=True)
    assert settings.scene.parts == str(tmp_path / "parts.npz")
    scene = Simulation.from_settings(parser, settings).scene
    assert [part.name for part in scene.parts.parts] == ["pot", "soil", "stem", "leaf", "surroundings"]
    assert not scene.parts.mask(role="still")[scene.simulated].any()


def test_bad_input_is_one_sentence(capsys, tmp_path):
    refused(live.main, [str(tmp_path / "none.ply"), "--device=cpu", "--no-browser"], capsys, "none.ply")
    refused(live.main, ["--solver.dxx=3", "--no-browser"], capsys, "dxx")


class FakePage:
    """A page whose user looks once and ends the command."""

    def __init__(self, *arguments):
        self.url, self.url_elsewhere = "http://127.0.0.1:8080", None
        self.progress = lambda *arguments: None
        self.scratch = None  # a configuration needs no folder
        self.close = lambda: None

    def show(self, session):
        FakePage.shown = session
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("options", "dx"), [([], 0.058), (["--grid", "configured"], 0.04), (["--solver.dx=0.06"], 0.06)]
)
def test_the_grid_is_chosen_for_real_time_unless_it_is_given(capsys, monkeypatch, tmp_path, options, dx):
    """On a machine on which the configured 0.04 m runs at half real time. The file stays as it is."""
    file = tmp_path / "mine.yaml"
    file.write_text(
        "scene: {generator: {class_path: FlagScene, init_args: {spacing: 0.04}}}\n"
        "solver: {dx: 0.04}\nframe_dt: 0.04\ndevice: cpu\n"
    )
    before = file.read_bytes()
    monkeypatch.setattr(live, "Server", FakePage)
    monkeypatch.setattr(live, "share_cores", lambda: None)
    monkeypatch.setattr("gaussian_swaying.player.session.estimate_cost", cubed)
    assert live.main([str(file), "--no-browser", *options]) == 0
    session = FakePage.shown
    told = capsys.readouterr().out
    assert session.settings.solver.dx == session.simulation.solver.dx == dx
    if options:
        assert "Chose" not in told
        assert session.configured_dx == dx
    else:
        line = next(line for line in told.splitlines() if line.startswith("Chose a grid of"))
        assert "instead of the configured 0.04 m (0.5 x): --grid configured" in line
        assert session.configured_dx == 0.04
    assert file.read_bytes() == before


def cubed(simulation, frames, budget, pictures):
    """Costs of a made-up machine, which grow as 1 / dx³."""
    finer = 0.04 / simulation.solver.dx
    seconds = (frames - 1) * simulation.frame_dt / 0.5 * finer**3
    return run_cost(simulation.solver.dx, substep_seconds=1e-3 * finer**2, simulation_seconds=seconds)


def test_ctrl_c_ends_it_cleanly(tmp_path):
    code = "import sys; from gaussian_swaying.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "live", "--no-browser", "--port=8500", "--device=cpu", "--solver.dx=0.1"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}
    )
    try:
        told = ""
        assert process.stdout is not None
        while "The wind blows at" not in told:
            line = process.stdout.readline()
            assert line, told
            told += line
        address = told.split("The wind blows at ")[1].split()[0]
        assert urllib.request.urlopen(address, timeout=20).status == 200
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=30)
        assert process.returncode == 0, rest
        assert "Traceback" not in rest
        assert "Ended." in rest
    finally:
        process.kill()


def test_a_splat_has_the_wind_of_its_preview(tmp_path):
    splat = tmp_path / "flag.ply"
    export_cloud(splat, FlagScene(spacing=0.05, stand="pole").generate())
    parser = Simulation.parser()
    live = settings_of_splat(parser, splat, torch.device("cpu"), tmp_path)
    assert preview([str(splat), "--output", str(tmp_path / "look"), "--device", "cpu"]) == 0
    starter = parser.parse_args(["--config", str(tmp_path / "look" / "starter.yaml")])
    turbulence = live.wind.effects[0]["init_args"]
    assert any(turbulence["start"])
    assert turbulence["start"] == starter.wind.effects[0]["init_args"]["start"]
    assert live.wind.flow == starter.wind.flow
