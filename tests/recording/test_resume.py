"""What happened to the files of a run before it is continued is found at the start, and told in one sentence."""

import json
import os
import random
import shutil
import socket

import imageio.v3 as iio
import numpy as np
import pytest
from shared import contents

from gaussian_swaying._files import kind_of, remove_temporaries, temporary_name, write_json
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.recording.trajectory import load_trajectory

FRAMES = 3


@pytest.fixture
def run(make_simulation, tmp_path):
    """A complete run of three frames whose trajectory of the last is not joined yet, and how to go on to a fourth."""
    simulation, folder = make_simulation(), tmp_path / "run"
    recorder = Recorder(renders=["color", "depth"], ply_every=1)
    simulation.run(folder, FRAMES, progress=False, recorder=recorder)
    (folder / "trajectory").mkdir()
    position, F = load_trajectory(folder / "trajectory.npz", 2)
    arrays = {"position_00002": position.numpy(), "F_00002": F.numpy().astype(np.float16)}
    np.savez(folder / "trajectory" / "00002.npz", **arrays)

    def resume():
        return simulation.run(folder, FRAMES + 1, resume=True, progress=False, recorder=recorder)

    return folder, resume


def _refused(resume, folder, case=""):
    before = contents(folder)
    with pytest.raises(ValueError, match=r"^[^\n]*(start again without --resume|move it away)\.$") as caught:
        resume()
    assert contents(folder) == before, case
    return str(caught.value)


READ = ["frames/00001.png", "depth/00001.png", "depth_raw/00001.png", "trajectory/00002.npz"]
READ += ["trajectory.npz", "nodes.npz"]


def test_damaged_files_are_found_at_the_start(run):
    """Cut short, empty, overwritten; each is named, and nothing is changed."""
    folder, resume = run
    for name in READ:
        content = (folder / name).read_bytes()
        half = len(content) // 2
        for broken in (
            content[:half],
            b"",
            b"hello",
            bytes(len(content)),
            content[:half] + b"????" + content[half + 4 :],
        ):
            (folder / name).write_bytes(broken)
            assert f"{folder / name} is damaged (" in _refused(resume, folder, name)
        (folder / name).write_bytes(content)
    assert resume()["frames"] == FRAMES + 1


def test_bits_that_change_are_found_or_change_nothing(run, tmp_path):
    """72 single bits of what was recorded: refused in the sentence, or the run ends with the same numbers."""
    folder, resume = run
    generator, refused, same = random.Random(0), 0, 0
    kept = tmp_path / "kept"
    shutil.copytree(folder, kept)
    resume()
    expected = [load_trajectory(folder / "trajectory.npz", frame) for frame in range(FRAMES + 1)]
    pictures = [iio.imread(folder / "frames" / f"{frame:05d}.png") for frame in range(FRAMES + 1)]
    for _ in range(12):
        for name in READ:
            shutil.rmtree(folder)
            shutil.copytree(kept, folder)
            content = bytearray((folder / name).read_bytes())
            content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
            (folder / name).write_bytes(content)
            said = None
            try:
                resume()
            except ValueError as error:
                said = str(error)
            if said is not None:
                assert f"{folder / name} is damaged (" in said
                assert "\n" not in said
                refused += 1
                continue
            same += 1
            for frame in range(FRAMES + 1):
                for one, other in zip(load_trajectory(folder / "trajectory.npz", frame), expected[frame], strict=True):
                    assert one.equal(other)
                assert np.array_equal(iio.imread(folder / "frames" / f"{frame:05d}.png"), pictures[frame])
    assert refused + same == 72
    assert refused > 50


def test_files_of_another_run_are_no_frames_of_this(run):
    folder, resume = run
    content = (folder / "frames/00001.png").read_bytes()
    iio.imwrite(folder / "frames/00001.png", np.zeros((9, 16, 3), np.uint8))
    assert "it is 16 x 9 RGB, and the frames before it are 32 x 18 RGB" in _refused(resume, folder)
    iio.imwrite(folder / "frames/00001.png", np.zeros((18, 32), np.uint8))
    assert "it is 32 x 18 L" in _refused(resume, folder)
    (folder / "frames/00001.png").write_bytes(content)
    content = (folder / "trajectory.npz").read_bytes()
    for arrays in (
        {"position_00000": np.zeros((5, 3), np.float32)},
        {"position_00000": np.zeros((96, 3))},
        {"F_00000": np.zeros((96, 3), np.float16)},
        {"walk": np.zeros(3)},
        {"position_00000": np.array([{}] * 3, dtype=object)},
    ):
        np.savez(folder / "trajectory.npz", **arrays)
        assert "trajectory.npz is damaged (" in _refused(resume, folder)
    (folder / "trajectory.npz").write_bytes(content)
    resume()


def test_missing_files_are_told(run, capsys):
    """The run goes on without them: they may have been removed on purpose."""
    folder, resume = run
    for name in ("frames/00000.png", "frames/00001.png", "depth_raw/00001.png", "ply/00000.ply", "trajectory.npz"):
        (folder / name).unlink()
    (folder / "summary.json").unlink()
    (folder / "run.json").unlink()
    summary = resume()
    warnings = capsys.readouterr().err.splitlines()
    assert [line for line in warnings if not line.startswith("warning: ")] == []
    for words in (
        "frames/00000.png and 1 more are missing, so video.mp4 will be without them; start again",
        "depth_raw/00001.png is missing; start again",
        "trajectory/00000.npz and 1 more are missing, so trajectory.npz will be without them",
        "ply/00000.ply is missing",
    ):
        assert sum(words in line for line in warnings) == 1, (words, warnings)
    assert len(warnings) == 4
    assert summary["status"] == "complete"
    assert len(iio.imread(folder / "video.mp4")) == 2
    assert json.loads((folder / "summary.json").read_text())["frames"] == FRAMES + 1
    assert (folder / "run.json").exists()


NAMES = [*READ, "checkpoint.pt", "summary.json", "diagnostics.csv", "video.mp4", "config.yaml", "run.json"]
NAMES += ["frames/00003.png", "ply/00003.ply"]


@pytest.mark.parametrize("kind", ["folder", "pipe", "socket"])
@pytest.mark.timeout(60)
def test_what_is_no_file_keeps_nobody_waiting(kind, run):
    if kind != "folder" and not hasattr(os, "mkfifo"):
        pytest.skip("needs named pipes")
    folder, resume = run
    for name in NAMES:
        path, aside = folder / name, folder / "aside"
        if path.exists():
            path.rename(aside)
        if kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        else:
            with socket.socket(socket.AF_UNIX) as end:
                here = os.getcwd()
                os.chdir(path.parent)  # names of sockets are short
                end.bind(path.name)
                os.chdir(here)
        message = _refused(resume, folder, name)
        assert str(path) in message
        assert {"folder": "a folder", "pipe": "a named pipe", "socket": "a socket"}[kind] in message
        path.rmdir() if kind == "folder" else path.unlink()
        if aside.exists():
            aside.rename(path)
    shutil.rmtree(folder / "frames")
    (folder / "frames").write_text("hello")
    assert "frames to be a folder, but it is a file" in _refused(resume, folder)


def test_what_a_path_is(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "nowhere").symlink_to(tmp_path / "nothing")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    kinds = {"file": "file", "link": "file", "nowhere": "link to nothing", "loop": "link to itself", "none": None}
    kinds |= {".": "folder", "file/in": None}
    assert {name: kind_of(tmp_path / name) for name in kinds} == kinds


def test_numbers_that_json_does_not_have(tmp_path):
    write_json(
        tmp_path / "a.json", {"a": [float("nan"), float("-inf"), 1.5, None], "b": (1, "x"), "c": {"d": float("inf")}}
    )
    held = json.loads((tmp_path / "a.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert held == {"a": [None, None, 1.5, None], "b": [1, "x"], "c": {"d": None}}


def test_only_unfinished_files_of_ours_are_removed(tmp_path):
    ours = temporary_name(tmp_path / "00001.compressed.ply")
    theirs = [".my.notes.txt", ".a.b.c", ".bashrc", ".x.gs-writing-", ".x.gs-writing-12.a.b", "x.gs-writing-12.png"]
    for name in (ours.name, ".video.gs-writing-99.mp4", *theirs):
        (tmp_path / name).write_text("x")
    (tmp_path / ".folder.gs-writing-1").mkdir()
    remove_temporaries(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*theirs, ".folder.gs-writing-1"}
