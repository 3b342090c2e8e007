"""tools/preview.py: what it writes, that the configuration runs unchanged, and its answers to bad input."""

import dataclasses
import json
import math
import re
import shlex
from pathlib import Path

import pytest
import torch
import yaml
from places import place
from shared import refused
from small_scenes import plain_cloud, together
from things import potted_plant

from gaussian_swaying.cli.preview import doubts, main
from gaussian_swaying.cli.simulate import main as simulate
from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.gaussians.ply import read_ply, write_ply
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.suggestion.suggest import suggest

ROOT = Path(__file__).parents[2]
FLAG = ROOT / "configs/sim/flag.yaml"


@pytest.fixture(autouse=True)
def _few_frames(monkeypatch):
    monkeypatch.setattr("gaussian_swaying.suggestion.cost.MOST_FRAMES", 2)


def test_where_map_coordinates_begin(tmp_path, capsys):
    flag, out = FlagScene(spacing=0.08).generate(), str(tmp_path / "out")
    write_ply(tmp_path / "a.ply", dataclasses.replace(flag, origin=(500123.0, 4649776.0, 312.0)))
    given = ["--device", "cpu", "--frames", "2"]
    assert main([str(tmp_path / "a.ply"), "--output", out, "--height", "96", *given]) == 0
    begin = list(read_ply(tmp_path / "a.ply").origin)
    words = f"coordinates count from {begin} of the file"
    assert words in capsys.readouterr().out
    assert simulate(["--config", f"{out}/starter.yaml", "--output", str(tmp_path / "run"), *given]) == 0
    assert words in capsys.readouterr().out
    assert json.loads((tmp_path / "run/summary.json").read_text())["file_origin"] == begin


@pytest.fixture
def splat(tmp_path):
    path = tmp_path / "flag.ply"
    write_ply(path, FlagScene(spacing=0.08).generate())
    return path


def preview(splat, output, *options):
    scene = [] if splat is None else [str(splat)]
    return main([*scene, "--output", str(output), "--device", "cpu", "--height", "96", "--verbose", *options])


def check_refused(splat, tmp_path, capsys, *options, words):
    refused(lambda given: preview(splat, tmp_path / "out", *given), options, capsys, words, folder=tmp_path)


def test_the_report_and_its_files(splat, tmp_path, capsys):
    out = tmp_path / "out"
    assert preview(splat, out, "--frames", "3", "--quality", "draft") == 0
    report = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["preview.json", "preview.png", "starter.yaml"]
    data = json.loads((out / "preview.json").read_text())
    assert data["suggestion"]["up"]["direction"] == [0, 0, 1]
    assert data["suggestion"]["hold"]["name"] == "side"
    assert data["cost"]["frames"] == 3
    assert data["cost"]["total_seconds"] > data["cost"]["startup_seconds"] > 0
    assert "the starter (0.12 s" in report
    for words in (
        "150 Gaussians",
        "confidence medium",
        "quality draft: dx = 0.14 m",
        f"--config {out / 'starter.yaml'}",
    ):
        assert words in report


def test_ten_lines_and_a_command_for_a_shell(splat, tmp_path, capsys):
    folder = tmp_path / "my scan #1"
    folder.mkdir()
    splat.rename(folder / "flag.ply")
    assert preview(folder / "flag.ply", folder / "out", "--frames", "3") == 0
    whole = capsys.readouterr().out
    options = [str(folder / "flag.ply"), "--output", str(folder / "out"), "--height", "96", "--frames", "3"]
    assert main([*options, "--device", "cpu"]) == 0
    told, said = capsys.readouterr()
    lines = [line for line in told.splitlines() if "warning" not in line]
    assert len(lines) == 10 < len(whole.splitlines()) / 2
    assert told.splitlines()[1].split(";")[0] in whole
    assert shlex.split(lines[-2])[2:] == ["--config", str(folder / "out/starter.yaml"), "--output", "outputs/out"]
    assert lines[-1].endswith("starter.yaml; --verbose says more")
    assert "PinnedRegion" not in said


def test_specks_are_noted_and_follow(splat, tmp_path, capsys):
    assert preview(splat, tmp_path / "plain") == 0
    assert "hang on nothing" not in capsys.readouterr().out
    cloud = FlagScene(spacing=0.08).generate()
    means, pairs = cloud.means.clone(), torch.tensor([0, 0, 1, 1])
    specks = dataclasses.replace(
        cloud.select(pairs), means=means[75] + 0.3 * torch.tensor([[0.0, 1, 0], [0, -1, 0]])[pairs]
    )
    write_ply(splat, together(cloud, specks))
    out = tmp_path / "out"
    region = ["--region", "-1", "-1", "-1", "2", "1", "2"]
    assert preview(splat, out, "--up", "+z", "--hold", "-x", "--frames", "2", *region) == 0
    report = capsys.readouterr().out
    assert "note: 4 specks hang on nothing or by a thread; they follow their nearest neighbours" in report
    assert "warning" not in report
    small = ["--camera.init_args.width", "32", "--camera.init_args.height", "18", "--recorder.video", "false"]
    assert yaml.safe_load((out / "starter.yaml").read_text())["scene"]["loose"] == "carry"
    run = tmp_path / "run"
    assert simulate(["--config", str(out / "starter.yaml"), "--output", str(run), "--frames", "2", *small]) == 0
    assert "4 loose ones follow their neighbours" in capsys.readouterr().out
    assert json.loads((run / "summary.json").read_text())["loose_gaussians"] == 4


def test_a_material_may_be_given(splat, tmp_path, capsys):
    assert preview(splat, tmp_path / "out", "--material", "rubber", "--frames", "2") == 0
    assert "rubber, E = 2e+06 Pa, 925 kg/m^3, 0.002 m thick; as it was given" in capsys.readouterr().out
    check_refused(splat, tmp_path, capsys, "--material", "ruber", words="'ruber'")


def test_edited_starter_is_kept(splat, tmp_path):
    out = tmp_path / "out"
    for change in ("", "# mine\n", "# mine too\n"):
        if change:
            (out / "starter.yaml").write_text(change)
        assert preview(splat, out) == 0
    assert (out / "starter.1.yaml").read_text() == "# mine\n"
    assert (out / "starter.2.yaml").read_text() == "# mine too\n"
    assert preview(splat, out) == 0  # the same again: nothing to keep
    assert not (out / "starter.3.yaml").exists()


def test_parts_are_written_and_those_that_were_edited_are_kept(tmp_path, capsys):
    write_ply(tmp_path / "plant.ply", potted_plant(0.02))
    out = tmp_path / "out"
    given = ["--quality", "draft", "--frames", "2"]
    assert preview(tmp_path / "plant.ply", out, *given) == 0
    told = capsys.readouterr().out
    assert "pot still" in told
    assert "each connected part has its own (scene.connected: surface), as" in told
    assert str(out / "parts.npz") in told
    config = yaml.safe_load((out / "starter.yaml").read_text())
    assert config["scene"]["parts"] == str(out / "parts.npz")
    assert (config["solver"]["boundaries"], config["scene"]["connected"]) == ([], "surface")
    parts = Parts.load(out / "parts.npz")
    painted = Parts(parts.labels.flip(0), parts.parts)
    painted.save(out / "parts.npz")
    for _ in range(2):
        assert preview(tmp_path / "plant.ply", out, *given) == 0
    assert Parts.load(out / "parts.1.npz").digest() == painted.digest()
    assert Parts.load(out / "parts.npz").digest() == parts.digest()
    assert not (out / "parts.2.npz").exists()


def test_a_thing_of_a_place_is_chosen_by_its_number(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.cli.preview.LARGE", 0)
    write_ply(tmp_path / "garden.ply", place(20_000, sh_degree=1)[0])
    out = tmp_path / "out"
    assert preview(tmp_path / "garden.ply", out, "--move", "2, 2", "--frames", "2", "--quality", "draft") == 0
    told = capsys.readouterr().out
    for words in ("only constant colours were read", "2 moves", "thing 2 of the place", "background"):
        assert words in told
    assert (out / "things.png").exists()
    found = json.loads((out / "preview.json").read_text())["suggestion"]
    assert (found["moves"], len(found["place"]["things"])) == ([2], 2)


def test_a_weak_guess_comes_with_the_option_of_the_next_best(tmp_path, capsys):
    """Of the object, too: clusters of a dozen, of which none is known to be it."""
    torch.manual_seed(0)
    places = (100 * torch.rand(200, 3)).repeat_interleave(12, 0) + 0.1 * torch.randn(2400, 3)
    write_ply(tmp_path / "a b.ply", plain_cloud(places, math.log(0.5)))
    assert preview(tmp_path / "a b.ply", tmp_path / "out", "--frames", "2") == 0
    told = capsys.readouterr().out
    assert re.search(r"warning: that these \d+ Gaussians are the object is a weak guess", told)
    assert re.search(r"give another box than --region( -?[\d.]+){6}\n", told)
    assert re.search(r"the next best is --up [+-][xyz]\n", told)


def test_what_is_rigid_comes_with_a_way_to_make_it_swing(splat):
    found = suggest(splat, tune=False)
    notes = {
        kind: [line for line in doubts(dataclasses.replace(found, kind=kind)) if "--kind" in line]
        for kind in ("flag", "rigid")
    }
    assert notes["flag"] == []
    assert notes["rigid"] == ["note: little of it sways; if it hangs, add --kind hanging"]


def test_options_replace_guesses(splat, tmp_path, capsys):
    assert preview(splat, tmp_path / "a", "--up", "-y", "--hold", "+x", "--longest-side", "2") == 0
    found = json.loads((tmp_path / "a/preview.json").read_text())["suggestion"]
    assert found["up"]["direction"] == [0, -1, 0]
    assert found["hold"]["direction"] == [1, 0, 0]
    assert found["longest_side"] == 2
    starter = yaml.safe_load((tmp_path / "a/starter.yaml").read_text())
    assert starter["scene"]["up"] == [0, -1, 0]
    said = capsys.readouterr().out
    assert "given" in said
    assert preview(splat, tmp_path / "b", "--up", "0", "-1", "0.5", "--region", "0", "-1", "0", "0.6", "1", "1") == 0
    other = json.loads((tmp_path / "b/preview.json").read_text())
    assert other["suggestion"]["up"]["direction"][2] == pytest.approx(0.2**0.5)
    flow = starter["wind"]["flow"]  # with z up; in scene axes as regions are, where y points down
    there = f"([{flow[0]:.3g}, 0, {flow[1]:.3g}] in scene axes)"
    assert there in (tmp_path / "a/starter.yaml").read_text()
    assert there in said
    assert other["suggestion"]["moving"]["simulated"] == 80  # 8 of 15 columns of 10


def test_a_configuration_is_previewed_as_it_is(splat, tmp_path, capsys):
    options = ["--config", str(FLAG)]
    assert preview(splat, tmp_path / "out", *options) == 2  # its pole is thinner than this flag's spacing
    assert "holds no particle" in capsys.readouterr().err
    mine = tmp_path / "mine.yaml"
    pin = {"class_path": "PinnedRegion", "init_args": {"region": {"class_path": "Box", "init_args": {
        "min": [None] * 3, "max": [0.1, None, None]}}}}  # fmt: skip
    mine.write_text(yaml.safe_dump({"scene": {"region": {"class_path": "Box", "init_args": {
        "min": [None] * 3, "max": [None, None, 0.5]}}}, "frames": 7, "solver": {"dx": 0.2, "boundaries": [pin]},
        "wind": {"flow": [1.0, 2.0, 0.0]}, "recorder": {"renders": []}}))  # fmt: skip
    assert preview(splat, tmp_path / "out", "--config", str(mine)) == 0
    report = capsys.readouterr().out
    data = json.loads((tmp_path / "out/preview.json").read_text())
    for words in ("  90 of 150 Gaussians", "wind            [1, 2, 0] m/s, z up, before modulations"):
        assert words in report
    assert data["cost"]["frames"] == 7
    assert data["cost"]["picture_seconds"] is None
    assert "PinnedRegion: 6 particles" in report
    assert not (tmp_path / "out/starter.yaml").exists()


def test_bad_input_is_one_sentence(splat, tmp_path, capsys):
    broken = tmp_path / "broken.ply"
    broken.write_text("not a splat")
    typo = tmp_path / "typo.yaml"
    typo.write_text("solver:\n  dxx: 1\n")
    for scene, options, words in (
        (tmp_path / "none.ply", [], "none.ply"),
        (broken, [], "broken.ply"),
        (None, [], "give SCENE.ply"),
        (splat, ["--up", "sideways"], "`--up`"),
        (splat, ["--up", "0", "0", "0"], "`--up`"),
        (splat, ["--up", "a", "b", "c"], "`--up`"),
        (splat, ["--hold", "left"], "`--hold`"),
        (splat, ["--region", "5", "5", "5", "6", "6", "6"], "`--region`"),
        (splat, ["--region", "5", "5", "5", "4", "6", "6"], "`min` to be below `max`"),
        (splat, ["--longest-side", "-1"], "`--longest-side`"),
        (splat, ["--wind", "nan"], "`--wind`"),
        (splat, ["--frames", "0"], "`--frames`"),
        (splat, ["--height", "7"], "`--height`"),
        (splat, ["--quality", "best"], "`--quality` to be one of draft, normal, fine"),
        (splat, ["--config", str(FLAG), "--move", "1"], "`--move` is for suggestions, and"),
        (splat, ["--move", "a"], "`--move` to be numbers of things"),
        (splat, ["--config", str(typo)], "dxx"),
        (splat, ["--capture", str(tmp_path / "nowhere")], "nowhere"),
        (splat, ["--config", str(tmp_path / "none.yaml")], "none.yaml"),
    ):
        check_refused(scene, tmp_path, capsys, *options, words=words)
