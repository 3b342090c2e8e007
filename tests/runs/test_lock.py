import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
from shared import value_error

from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder
from gaussian_swaying.runs.lock import LOCK, FolderLock, FolderLocked


def _claim(folder, ours=(), in_use=()):
    return claim_folder(folder, ours, "choose another", in_use)


def test_a_folder_is_held_until_it_is_released_or_forgotten(tmp_path):
    lock = FolderLock(tmp_path)
    with pytest.raises(FolderLocked, match=rf"process {os.getpid()} on this host.* choose another folder"):
        FolderLock(tmp_path)
    lock.release()
    lock.release()
    assert list(tmp_path.iterdir()) == []
    lock = FolderLock(tmp_path)
    del lock
    gc.collect()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_renamed_stays_locked(tmp_path):
    (tmp_path / "a").mkdir()
    lock = FolderLock(tmp_path / "a")
    (tmp_path / "a").rename(tmp_path / "b")
    lock.moved(tmp_path / "b")
    with pytest.raises(FolderLocked):
        FolderLock(tmp_path / "b")
    lock.release()
    assert list((tmp_path / "b").iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_process_holds_nothing_even_as_a_zombie_and_a_forked_copy_ends_nothing(tmp_path):
    code = (
        "import os, sys, pathlib\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "from gaussian_swaying.runs.lock import FolderLock\n"
        f"lock = FolderLock(pathlib.Path({str(tmp_path)!r}))\n"
        "if (copy := os.fork()) == 0: sys.exit()\n"
        "os.waitpid(copy, 0)\n"
        "print('mine', flush=True)\n"
        "sys.stdin.read()\n"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    child = subprocess.Popen([sys.executable, "-c", code], **pipes)
    assert child.stdout.readline() == "mine\n"
    with pytest.raises(FolderLocked, match=f"process {child.pid} on"):
        FolderLock(tmp_path)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    FolderLock(tmp_path).release()
    child.communicate()


@pytest.mark.parametrize("content", ["", "[1]", '{"pid": "x"}', "[" * 10000])
def test_a_file_that_nobody_holds_is_no_lock_whatever_it_says(content, tmp_path):
    (tmp_path / LOCK).write_text(content)
    lock = FolderLock(tmp_path)
    (tmp_path / LOCK).write_text(content)
    with pytest.raises(FolderLocked, match=r"Another run is writing"):
        FolderLock(tmp_path)
    lock.release()


# ---- claiming


def test_an_earlier_run_is_moved_aside_but_not_what_is_in_use(tmp_path, capsys):
    folder = tmp_path / "run"
    _claim(folder).release()
    (folder / "mine.ply").write_text("precious")
    with value_error(r"because .*mine.ply is in it and is needed now: choose"):
        _claim(folder, in_use=[folder / "mine.ply"])
    _claim(folder).release()
    assert (tmp_path / "run.1" / "mine.ply").read_text() == "precious"
    assert sorted(path.name for path in folder.iterdir()) == [MARKER]
    assert f"An earlier run in {folder} was moved to {tmp_path / 'run.1'}." in capsys.readouterr().out


def test_a_live_run_is_not_moved(tmp_path):
    folder = tmp_path / "run"
    lock = _claim(folder)
    for start in (lambda: _claim(folder), lambda: hold_folder(folder, "")):
        with pytest.raises(FolderLocked, match="Another run"):
            start()
    lock.release()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_folder_one_is_in(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    (folder / "deep").mkdir(parents=True)
    monkeypatch.chdir(folder)
    _claim(Path(".")).release()
    (folder / "mine.txt").write_text("precious")
    for place in (".", "../run", str(folder)):
        with value_error(r"because you are in that folder: choose another, or start from another"):
            _claim(Path(place))
    monkeypatch.chdir(folder / "deep")
    with value_error("you are in that folder"):
        _claim(Path(".."))
    assert sorted(path.name for path in folder.iterdir()) == ["deep", "mine.txt", MARKER]
    monkeypatch.chdir(tmp_path)
    _claim(Path("run")).release()
    assert "An earlier run in run was moved to run.1." in capsys.readouterr().out


def test_a_link_is_followed_and_stays(tmp_path, capsys):
    disk, link = tmp_path / "disk", tmp_path / "run"
    disk.mkdir()
    link.symlink_to(disk / "flag", target_is_directory=True)
    _claim(link).release()
    (link / "mine.txt").write_text("precious")
    _claim(link).release()
    assert link.is_symlink()
    assert link.resolve() == disk / "flag"
    assert (disk / "flag.1" / "mine.txt").read_text() == "precious"
    assert sorted(path.name for path in (disk / "flag").iterdir()) == [MARKER]
    assert str(disk / "flag.1") in capsys.readouterr().out
    link.unlink()
    link.symlink_to(link)
    with value_error("cannot be written"):
        _claim(link)
    assert link.is_symlink()


def test_what_is_no_folder(tmp_path):
    (tmp_path / "file").write_text("precious")
    with value_error(r"file cannot be written \(File exists\): choose another"):
        _claim(tmp_path / "file")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "summary.json").symlink_to(tmp_path / "nothing")
    with value_error(r"foreign contains summary.json of something else"):
        _claim(foreign, ["summary.json"])
    assert [path.name for path in foreign.iterdir()] == ["summary.json"]
