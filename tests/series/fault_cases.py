"""Faults of the machine: a disk that is full at some byte, standard streams that are closed or full, odd outputs."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

from sandbox import Case
from small import SMALL, splat_bytes

STREAMS = {"full": "/dev/full", "closed": "", "pipe": "|"}


def spoil(stream: str, how: str) -> None:
    """Close ``stdout`` or ``stderr`` of this process, or let it lead to a full disk or a pipe that nobody reads."""
    number = 1 if stream == "stdout" else 2
    if how == "closed":
        os.close(number)
        setattr(sys, stream, None)
        return
    if how == "pipe":
        reading, target = os.pipe()
        os.close(reading)
    else:
        target = os.open("/dev/full", os.O_WRONLY)
    os.dup2(target, number)


def _output(rng: random.Random, folder: Path) -> str:
    """A place that results cannot, or should not, go to."""
    (folder / "file").write_text("mine")
    (folder / "link").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "pipe")
    (folder / "full").mkdir()
    (folder / "full/notes.txt").write_text("mine")
    places = ["/dev/full", "/dev/null", "/proc/x", "", "a\0b", "x" * 300, str(folder / "file"), str(folder / "link")]
    return rng.choice([*places, str(folder / "pipe"), str(folder / "full"), str(folder / "file/below")])


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed."""
    for number in range(count):
        rng = random.Random(f"fault {seed} {number}")
        kind = rng.choice(("disk", "disk", "stream", "output", "ascii"))
        command = rng.choice(("sim", "sim", "export", "preview", "spoilt"))
        if kind in ("stream", "ascii"):
            command = "spoilt"
        elif command == "spoilt":
            command = "sim"

        def make(folder: Path, rng: random.Random = rng, kind: str = kind, command: str = command) -> list[str]:
            (folder / "flag.ply").write_bytes(splat_bytes())
            splat, out = str(folder / "flag.ply"), "out"
            if kind == "output":
                out = _output(rng, folder)
            given = {
                "sim": [*SMALL, "--output", out],
                "export": [splat, out if kind == "output" else "out.splat"],
                "preview": [splat, "--device", "cpu", "--height", "64", "--output", out],
            }
            if command != "spoilt":
                return given[command]
            name = rng.choice(("sim", "export", "preview"))
            options = rng.choice((given[name], ["--help"], ["--no_such_option"]))
            how = "ascii" if kind == "ascii" else rng.choice(("full", "closed", "pipe"))
            return [name, rng.choice(("stdout", "stderr")), how, *options]

        largest = int(10 ** rng.uniform(0, 5)) if kind == "disk" else 0
        yield Case("fault", f"{number} {kind} {command}", command, make, largest)
