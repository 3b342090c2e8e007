"""What is missing of a run before it is continued."""

import json

import imageio.v3 as iio
import pytest
from shared import contents, value_error

from gaussian_swaying._files import remove_temporaries, temporary_name
from gaussian_swaying.recording.recorder import Recorder

FRAMES = 3


@pytest.fixture
def run(make_simulation, tmp_path):
    simulation, folder = make_simulation(), tmp_path / "run"
    recorder = Recorder(renders=["color", "depth"])
    simulation.run(folder, FRAMES, progress=False, recorder=recorder)
    return folder, lambda: simulation.run(folder, FRAMES + 1, resume=True, progress=False, recorder=recorder)


def test_missing_files_are_told(run, capsys):
    folder, resume = run
    for name in ("frames/00000.png", "frames/00001.png", "depth_raw/00001.png", "trajectory.npz"):
        (folder / name).unlink()
    (folder / "summary.json").unlink()
    (folder / "run.json").unlink()
    summary = resume()
    warnings = capsys.readouterr().err.splitlines()
    assert [line for line in warnings if not line.startswith("warning: ")] == []
    for words in (
        "frames/00000.png and 1 more are missing, so video.mp4 will be without them; start again",
        "depth_raw/00001.png is missing; start again",
        "trajectory/00000.npz and 2 more are missing, so trajectory.npz will be without them",
    ):
        assert sum(words in line for line in warnings) == 1, (words, warnings)
    assert len(warnings) == 3
    assert summary["status"] == "complete"
    assert len(iio.imread(folder / "video.mp4")) == 2
    assert json.loads((folder / "summary.json").read_text())["frames"] == FRAMES + 1
    assert (folder / "run.json").exists()


def test_a_cut_trajectory_is_found_at_the_start(run):
    folder, resume = run
    (folder / "trajectory.npz").write_bytes((folder / "trajectory.npz").read_bytes()[:99])
    before = contents(folder)
    with value_error(r"trajectory\.npz is not a \.npz file, or is incomplete"):
        resume()
    assert contents(folder) == before


def test_only_unfinished_files_of_ours_are_removed(tmp_path):
    ours = temporary_name(tmp_path / "00001.compressed.ply")
    theirs = [".my.notes.txt", ".a.b.c", ".bashrc", ".x.gs-writing-", ".x.gs-writing-12.a.b", "x.gs-writing-12.png"]
    for name in (ours.name, ".video.gs-writing-99.mp4", *theirs):
        (tmp_path / name).write_text("x")
    (tmp_path / ".folder.gs-writing-1").mkdir()
    remove_temporaries(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*theirs, ".folder.gs-writing-1"}
