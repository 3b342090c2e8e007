"""One case in a process of its own, with limits on time and memory, and the verdict on how it ended.

The process is a fork of one that has imported everything, so a case takes milliseconds to start.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

Command = Callable[[list[str]], int | None]
GIGABYTE = 1 << 30
TIME = 30.0  # s of the processor; a case that takes more hangs, unless it shows progress
PATIENCE = 6.0  # times as long by the clock, as a machine may be busy with other things
GOOD = ("ran", "refused", "slow, but told")


@dataclass(frozen=True)
class Case:
    """Something to try.

    Attributes:
        series: Which series it belongs to.
        name: What is wrong with it.
        command: The name of a command, see ``commands.py``.
        make: Writes the input into an empty folder and gives the command's arguments.
        largest_file: Limit on the size of a file that is written [bytes], to act as a full disk; 0 for none.
    """

    series: str
    name: str
    command: str
    make: Callable[[Path], list[str]]
    largest_file: int = 0


@dataclass(frozen=True)
class Verdict:
    """How a case ended.

    Attributes:
        case: The case.
        kind: One of ``GOOD``; or ``traceback``, ``bug``, ``no sentence``, ``killed``, ``memory``, ``hang``.
        said: End of standard error.
        seconds: Time that it took [s].
        memory: Largest memory beyond that of the process before [bytes].
    """

    case: Case
    kind: str
    said: str
    seconds: float
    memory: int

    @property
    def good(self) -> bool:
        """Whether it is as it should be."""
        return self.kind in GOOD


def try_case(case: Case, commands: dict[str, Command], limit: float = TIME) -> Verdict:
    """Run a case and judge it."""
    with tempfile.TemporaryDirectory(prefix="series-") as name:
        folder = Path(name)
        (folder / "input").mkdir()
        arguments = case.make(folder / "input")
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        allowed = GIGABYTE + 10 * size
        before = _resident(os.getpid())
        began = time.monotonic()
        reading, writing = os.pipe()  # a file would be cut by `largest_file` too
        child = os.fork()
        if child == 0:
            os.close(reading)
            _child(case, commands[case.command], arguments, folder, writing)
        os.close(writing)
        ended, killed, said = _watch(child, reading, limit, before + allowed)
        os.close(reading)
        memory = ended[2].ru_maxrss * 1024 - before
        kind = killed or _kind(ended[1], said)
        if kind == "no sentence" and case.command == "spoilt" and not said.strip():
            kind = "refused"  # its standard error is what was spoilt
        if kind == "hang" and re.search(r"left in this frame|\[[^\]]*<\d[^\]]*frame", said):
            kind = "slow, but told"
        if kind in GOOD and memory > allowed:
            kind = "memory"
        return Verdict(case, kind, said[-500:].strip(), time.monotonic() - began, memory)


def _child(case: Case, command: Command, arguments: list[str], folder: Path, said: int) -> None:
    """The forked process; it does not return."""
    code = 99
    try:
        os.setsid()
        printed = os.open(os.devnull, os.O_WRONLY)
        for target, descriptor in ((printed, 1), (said, 2)):
            os.dup2(target, descriptor)
            os.close(target)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if case.largest_file:
            resource.setrlimit(resource.RLIMIT_FSIZE, (case.largest_file, case.largest_file))
        try:
            code = command(arguments) or 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):  # closed by the case
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _watch(
    child: int, reading: int, limit: float, memory: int
) -> tuple[tuple[int, int, resource.struct_rusage], str, str]:
    """Wait for a process; how it ended, what it was killed for, and the end of what it said."""
    killed, pause, said, deadline = "", 0.002, b"", time.monotonic() + PATIENCE * limit
    os.set_blocking(reading, False)
    while True:
        ended = os.wait4(child, os.WNOHANG)
        with suppress(BlockingIOError):
            while more := os.read(reading, 1 << 16):
                said = (said + more)[-(1 << 16) :]
        if ended[0]:
            _kill(child)  # what it left behind
            return ended, killed, said.decode(errors="replace")
        late = time.monotonic() > deadline or _seconds(child) > limit
        if not killed and (late or _resident(child) > memory + GIGABYTE):
            killed = "hang" if late else "memory"
            _kill(child)
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def _kill(group: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _resident(process: int) -> int:
    """Memory of a process [bytes]; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def _seconds(process: int) -> float:
    """Time that the processor spent on a process [s]; 0 if it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _kind(status: int, said: str) -> str:
    """What an exit status and standard error mean."""
    if not os.WIFEXITED(status):
        return "killed"
    code = os.WEXITSTATUS(status)
    if "Traceback (most recent call last)" in said or code == 99:
        return "traceback"
    if code == 1:
        return "bug"
    if code == 2:
        sentences = [line for line in said.splitlines() if "error: " in line]  # how to go on may follow it
        return "refused" if len(sentences) == 1 else "no sentence"
    return "ran" if code == 0 else "killed"
