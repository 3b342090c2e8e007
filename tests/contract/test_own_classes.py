"""docs/extending.md: each snippet does what the page says, in a file of a user's own; and a law of one's own."""

import gc
import importlib
import re
import runpy
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from shared import PIN, POLE, SMALL, longest, near, peak, value_error, words

from gaussian_swaying import Simulation, export_cloud, load_trajectory, read_gaussians
from gaussian_swaying._numbers import SENSE
from gaussian_swaying.cli import sweep
from gaussian_swaying.cli.simulate import main
from gaussian_swaying.config.parser import COMMON, OPTIONS
from gaussian_swaying.gaussians.formats import FORMATS
from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.variants import check_variants, states_of
from gaussian_swaying.player.panel import Panel
from gaussian_swaying.player.session import Session
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.scenes import FlagScene

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/extending.md").read_text()
SECTIONS = dict(part.split("\n", 1) for part in PAGE.split("\n## ")[1:])
PINS = "solver.boundaries"
TABLES = (FORMATS, PASSES, OPTIONS, COMMON, SENSE)


def _blocks(kind, text=PAGE):
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def _yaml(heading):
    return yaml.safe_load(_blocks("yaml", SECTIONS[heading])[0])


@pytest.fixture(scope="module")
def extensions(tmp_path_factory):
    folder, before = tmp_path_factory.mktemp("own"), [dict(table) for table in TABLES]
    (folder / "extensions.py").write_text("".join(_blocks("python")))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "examples/materials"))
        patch.syspath_prepend(str(folder))
        yield importlib.import_module("extensions")
    for table, old in zip(TABLES, before, strict=True):
        table.clear()
        table.update(old)
    for name in ("extensions", "custom_law"):
        sys.modules.pop(name, None)
    gc.collect()  # forces and modulations are found as subclasses


@pytest.fixture
def run(extensions, tmp_path):
    def run(name, changes, frames=4):
        assert main([*given(changes), f"--frames={frames}", f"--output={tmp_path / name}"]) == 0
        stored = yaml.safe_load((tmp_path / name / "config.yaml").read_text())
        return stored, torch.stack([load_trajectory(tmp_path / name / "trajectory.npz", k)[0] for k in range(frames)])

    return run


def given(changes):
    return [f"--config={ROOT / 'configs/sim/flag.yaml'}", "--device=cpu", *words(SMALL | changes)]


def made(changes):
    parser = Simulation.parser()
    return Simulation.from_settings(parser, parser.parse_args(given(changes)))


def own(name, **init_args):
    return {"class_path": f"extensions.{name}", "init_args": init_args}


def test_ten_changes_are_short_and_take_one_file():
    things = ("force", "unknown", "axis", "format", "boundary", "shape of pin", "pass", "camera", "unit", "option")
    for thing in things:
        (text,) = (text for heading, text in SECTIONS.items() if re.search(rf"\b{thing}\b", heading))
        first = _blocks("python", text)[0]
        assert 3 < len([line for line in first.splitlines() if line.strip()]) <= 40, thing


def test_a_force(run):
    still, name = {"wind.flow": [0, 0, 0]}, "forces.Pull.strength"
    pull = _yaml("A force with a live slider")
    free = run("free", still)[1]
    stored, pulled = run("pulled", still | pull)
    assert stored["forces"] == pull["forces"]
    assert (free[-1] - free[0])[:, 1].mean().abs() < 1e-3 < (pulled[-1] - pulled[0])[:, 1].mean()
    parser = Simulation.parser()
    session = Session(parser, parser.parse_args(given(pull)))
    slider = Panel(session).names()[name]
    shown = [slider[field] for field in ("kind", "label", "unit", "low", "high", "value")]
    assert shown == ["range", "Pull.strength", "N/m", 0.0, 5.0, 0.2]
    session.close()
    session.simulation.change(name, 2.0)
    assert session.simulation.custom_forces[0].strength == 2.0
    with value_error("to be from 0 to 5"):
        session.simulation.change(name, 6.0)


def test_an_unknown_of_a_fit(extensions, tmp_path):
    (tmp_path / "fit.yaml").write_text(_blocks("yaml", SECTIONS["An unknown of a fit"])[0])
    (unknown,) = read_plan(tmp_path / "fit.yaml").unknowns
    assert (unknown.name, unknown.low, unknown.high) == ("wind.modulations.0.growth", 0.1, 8.0)
    simulation = made({"wind.flow": [0, 2, 0], "wind.modulations": [own("Squall", growth=1.0)]})
    check_variants(simulation, [unknown])
    *_, ends = states_of(simulation, [{unknown.name: value} for value in (0.1, 8.0)], [0.0, 0.2])
    slow, fast = ((state.position - simulation.scene.points.position)[:, 1].mean() for state in ends)
    assert fast > 1.5 * slow > 0


def test_an_axis_of_a_sweep(extensions, tmp_path):
    sweep_file = _yaml("An axis of a sweep")
    sweep_file["base"] = str(tmp_path / "ribbon.yaml")
    settings = {"scene": {"generator": own("Ribbon")}, "recorder": {"renders": []}, "frames": 2}
    (tmp_path / "ribbon.yaml").write_text(yaml.safe_dump(settings | {"solver": {"dx": 0.2}}))
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(sweep_file))
    assert (
        sweep.main([str(tmp_path / "sweep.yaml"), "--workers=1", "--device=cpu", f"--output={tmp_path / 'out'}"]) == 0
    )
    rests = [load_trajectory(tmp_path / f"out/runs/0000{k}/trajectory.npz", 0)[0] for k in (0, 1)]
    assert [len(rest) for rest in rests] == [40, 80]
    assert [float(rest[:, 0].max() - rest[:, 0].min()) for rest in rests] == pytest.approx([0.45, 0.95])


def test_a_format(extensions, tmp_path):
    cloud = FlagScene(spacing=0.1).generate()
    export_cloud(tmp_path / "flag.npz", cloud)
    found = read_gaussians(tmp_path / "flag.npz")
    for name in (*extensions.FIELDS[2:], "means"):
        assert torch.equal(getattr(found, name), getattr(cloud, name))
    near(found.quats, cloud.quats, 1e-6)  # of unit length
    export_cloud(tmp_path / "flag.sog", cloud)
    assert len(read_gaussians(tmp_path / "flag.sog")) == 96  # begins alike
    *_, frame = Simulation(tmp_path / "flag.npz", device="cpu").frames(1)
    frame.save(tmp_path / "frame.npz")
    assert len(read_gaussians(tmp_path / "frame.npz")) == 96


def test_a_boundary(run):
    stored, moved = run("shaken", {PINS: [own("Shaker", region=POLE, amplitude=0.05, period=0.16)]})
    assert stored["solver"]["boundaries"][0]["class_path"] == "extensions.Shaker"
    held = first_column(moved)
    up = (moved - moved[0])[:, held, 2]
    # frames are a quarter of a period apart
    expected = torch.tensor([0.0, 0.05, 0.0, -0.05])[:, None].expand_as(up)
    near(up, expected, 1e-5)
    assert (moved[1] - moved[0])[~held].norm(dim=-1).min() > 0


def test_a_boundary_stands_beside_those_of_the_package(run):
    free = run("free", {})[1]
    stored, slow = run("slow", {PINS: [PIN, own("SpeedLimit", limit=0.1)]})
    names = [boundary["class_path"] for boundary in stored["solver"]["boundaries"]]
    assert names[1] == "extensions.SpeedLimit"
    assert names[0].rsplit(".", 1)[1] == "PinnedRegion"
    ways = [float(longest(moved[1:] - moved[:-1])) for moved in (free, slow)]
    assert ways[1] <= 0.1 * 0.04 * 1.001 < ways[0]


def first_column(moved):
    held = moved[0, :, 0] < moved[0, :, 0].min() + 0.05
    assert int(held.sum()) == 8
    return held


def test_a_shape_of_pin(run):
    """Exactly what is in it stays."""
    _, moved = run("slab", {PINS: _yaml("A shape of pin")["solver"]["boundaries"]})
    held = first_column(moved)
    assert peak((moved - moved[0])[:, held]) < 1e-6
    assert (moved[-1] - moved[0])[~held].norm(dim=-1).min() > 0


def test_a_pass(run, tmp_path):
    run("run", {"recorder.renders": ["color", "moved"], "recorder.video": False})
    first, last = (iio.imread(tmp_path / f"run/moved/0000{frame}.png").astype(int) for frame in (0, 3))
    assert np.unique(first.reshape(-1, 3), axis=0).tolist() == [[0, 0, 0], [68, 1, 84]]
    assert last[..., 1].max() > 30


def test_a_camera(extensions):
    painter = made({"camera": own("Crane", rise=2.0, width=32, height=18)}).painter
    eyes = [painter.camera_at(frame).position for frame in (0, 25)]
    near(eyes[1] - eyes[0], torch.tensor([0.0, 0.0, 2.0 * painter.size]), 1e-4)


def test_a_unit(extensions):
    with value_error("Expected `canopy` from 0.01 to 200 m, but got 500"):
        extensions.Canopy(500.0)


def test_an_effect_of_the_wind(run):
    wind = {"wind.flow": [0, 8, 0]}
    free = run("free", wind)[1]
    stored, moved = run("below", wind | {"wind.effects": [own("Canopy", canopy=0.01)]})
    assert stored["wind"]["effects"] == [own("Canopy", canopy=0.01, factor=0.0)]
    ways = [(end[1] - end[0])[:, 1] for end in (free, moved)]
    z = moved[0, :, 2]
    assert ways[1][z < -0.2].mean() < 0.2 * ways[0][z < -0.2].mean()
    assert ways[1][z > 0.2].mean() > 0.8 * ways[0][z > 0.2].mean()


def test_an_option(run, extensions, monkeypatch, capsys):
    stored, _ = run("wind", {"beaufort": 4}, 1)
    assert stored["wind"]["flow"] == pytest.approx([6.688, 0.0, 0.0])
    monkeypatch.setattr(sys, "argv", ["extensions.py", "sim", "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(extensions.__file__, run_name="__main__")
    assert end.value.code == 0
    assert "as a force on Beaufort's scale" in capsys.readouterr().out


def test_a_law(run):
    law = {"class_path": "custom_law.SaintVenant", "init_args": {"factor": 2.0}}
    stored, stiff = run("one", {"material.law": law}, 2)
    assert stored["material"]["law"] == law
    soft = run("soft", {"material.law": "custom_law.SaintVenant"}, 2)[1]
    corotated = run("corotated", {"material.law": "FixedCorotated"}, 2)[1]
    assert peak(stiff[1] - stiff[0]) > 1e-3
    assert peak(stiff[1] - soft[1]) > 1e-6
    # of the same stiffness at rest
    assert peak(soft[1] - corotated[1]) < 0.1 * peak(soft[1] - soft[0])
