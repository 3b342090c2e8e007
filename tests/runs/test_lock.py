"""One writer per folder, however two of them meet.

Covers: runs.folder.
"""

import gc
import itertools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from gaussian_swaying.runs import lock as lock_module
from gaussian_swaying.runs.folder import MARKER, claim_folder, hold_folder
from gaussian_swaying.runs.lock import LOCK, FolderLock, FolderLocked


def _claim(folder, ours=(), in_use=()):
    return claim_folder(folder, ours, "choose another", in_use)


def _lock_of(folder, **changes):
    """A lock as another process would have written it."""
    held = json.loads(lock_module._describe()) | changes
    (folder / LOCK).write_text(json.dumps(held))


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


def test_a_process_that_is_gone_holds_nothing(tmp_path):
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    _lock_of(tmp_path, pid=int(gone.stdout))
    FolderLock(tmp_path).release()
    if Path("/proc/self/stat").exists():  # the number of a process that is gone was given to another one
        _lock_of(tmp_path, begun="another boot 1")
        FolderLock(tmp_path).release()
    assert list(tmp_path.iterdir()) == []


def test_a_zombie_holds_nothing(tmp_path):
    """Killed, but its parent has not asked for its exit code yet."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("needs Linux")
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    begun = lock_module._begun(child.pid)
    assert begun
    _lock_of(tmp_path, pid=child.pid, begun=begun)
    with pytest.raises(FolderLocked, match=f"process {child.pid}"):
        FolderLock(tmp_path)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    FolderLock(tmp_path).release()
    child.wait()


@pytest.mark.parametrize("change", [{"host": "elsewhere"}, {"space": "pid:[1]"}])
def test_whether_a_process_elsewhere_lives_is_not_known(change, tmp_path):
    _lock_of(tmp_path, **change)
    with pytest.raises(FolderLocked, match=rf"A run on the host .* remove .*{LOCK} if it is not running any more"):
        FolderLock(tmp_path)


@pytest.mark.parametrize("content", ["", "no JSON", "[1]", '{"pid": "x"}', "[" * 10000])
def test_a_lock_that_cannot_be_read_is_no_licence(content, tmp_path):
    (tmp_path / LOCK).write_text(content)
    with pytest.raises(FolderLocked, match=f"{LOCK} cannot be read"):
        FolderLock(tmp_path)
    assert (tmp_path / LOCK).read_text() == content


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_in_place_of_the_lock_keeps_nobody_waiting(tmp_path):
    os.mkfifo(tmp_path / LOCK)
    with pytest.raises(ValueError, match="named pipe"):
        FolderLock(tmp_path)


def test_without_hard_links(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    lock = FolderLock(tmp_path)
    with pytest.raises(FolderLocked):
        FolderLock(tmp_path)
    lock.release()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("before", ["nothing", "a stale lock"])
def test_of_many_that_start_at_once_one_gets_the_folder(before, tmp_path):
    """Processes, as in life; they wait for each other before they begin."""
    if before == "a stale lock":
        _lock_of(tmp_path, pid=2**22 + 1)  # larger than any process number of Linux
    code = (
        "import sys, time, pathlib\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "from gaussian_swaying.runs.lock import FolderLock, FolderLocked\n"
        "print('ready', flush=True)\n"
        "sys.stdin.readline()\n"
        f"try: lock = FolderLock(pathlib.Path({str(tmp_path)!r}))\n"
        "except FolderLocked: print('refused', flush=True)\n"
        "else: print('mine', flush=True)\n"
        "sys.stdin.readline()\n"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    runs = [subprocess.Popen([sys.executable, "-c", code], **pipes) for _ in range(4)]
    for run in runs:
        assert run.stdout.readline() == "ready\n"
    for run in runs:
        run.stdin.write("go\n")
        run.stdin.flush()
    said = sorted(run.stdout.readline().strip() for run in runs)
    for run in runs:
        run.communicate("end\n")
    assert said == ["mine", "refused", "refused", "refused"]
    assert list(tmp_path.iterdir()) == []


def test_threads_that_take_over_a_stale_lock(tmp_path, monkeypatch):
    """All of them have seen the same stale lock before the first of them replaces it."""
    _lock_of(tmp_path, pid=2**22 + 1)
    check, all_seen = lock_module._check_stale, threading.Barrier(4)
    count = itertools.count()

    def seen(folder, content):
        check(folder, content)
        if b"4194305" in content:
            all_seen.wait(10)

    monkeypatch.setattr(lock_module, "_check_stale", seen)
    # each thread with files of its own, as processes have
    monkeypatch.setattr(lock_module, "temporary_name", lambda path: path.with_name(f".{next(count)}"))
    got, refused = [], []

    def take():
        try:
            got.append(FolderLock(tmp_path))
        except FolderLocked as error:
            refused.append(error)

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len(got) == 1
    assert len(refused) == 3


# ---- claiming


def test_an_earlier_run_is_moved_aside_but_not_what_is_in_use(tmp_path, capsys):
    folder = tmp_path / "run"
    _claim(folder).release()
    (folder / "mine.ply").write_text("precious")
    with pytest.raises(ValueError, match=r"because .*mine.ply is in it and is needed now: choose"):
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
        with pytest.raises(ValueError, match=r"because you are in that folder: choose another, or start from another"):
            _claim(Path(place))
    monkeypatch.chdir(folder / "deep")
    with pytest.raises(ValueError, match="you are in that folder"):
        _claim(Path(".."))
    assert sorted(path.name for path in folder.iterdir()) == ["deep", "mine.txt", MARKER]
    monkeypatch.chdir(tmp_path)
    _claim(Path("run")).release()
    assert "An earlier run in run was moved to run.1." in capsys.readouterr().out


def test_a_link_is_followed_and_stays(tmp_path, capsys):
    """Also one that points to nothing yet."""
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
    with pytest.raises(ValueError, match="cannot be written"):
        _claim(link)
    assert link.is_symlink()


def test_what_is_no_folder(tmp_path):
    (tmp_path / "file").write_text("precious")
    with pytest.raises(ValueError, match=r"file cannot be written \(File exists\): choose another"):
        _claim(tmp_path / "file")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "summary.json").symlink_to(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"foreign contains summary.json of something else"):
        _claim(foreign, ["summary.json"])
    assert [path.name for path in foreign.iterdir()] == ["summary.json"]
