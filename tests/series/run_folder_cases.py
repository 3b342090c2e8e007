"""Run folders with something wrong: altered, missing and exchanged files before a resume, an export or a comparison.

Only what a user can do: commands on a folder that was spoiled.
"""

from __future__ import annotations

import functools
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from sandbox import Case
from small import SMALL

Change = Callable[[random.Random, Path], None]
ALL = ("checkpoint.pt", "config.yaml", "diagnostics.csv", "run.json", "summary.json", "trajectory.npz", "video.mp4")
WEIGHTS = (8, 2, 1, 2, 3, 4, 1)


@functools.cache
def _run() -> Path:
    """A run of two frames, with its checkpoint."""
    from gaussian_swaying.cli.simulate import main

    folder = Path(tempfile.mkdtemp(prefix="series-run-")) / "run"
    given = [*SMALL, "--recorder.checkpoint_every", "1"]
    given[given.index("--output") + 1] = str(folder)
    assert main(given) == 0
    return folder


def _file(rng: random.Random, folder: Path) -> Path:
    if rng.random() < 0.15:
        return rng.choice(sorted((folder / "frames").iterdir()))
    return folder / rng.choices(ALL, WEIGHTS)[0]


def _flip(rng: random.Random, folder: Path) -> None:
    file = _file(rng, folder)
    data = bytearray(file.read_bytes())
    for _ in range(rng.choice((1, 1, 10))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    file.write_bytes(data)


def _cut(rng: random.Random, folder: Path) -> None:
    file = _file(rng, folder)
    data = file.read_bytes()
    file.write_bytes(data[: rng.randrange(len(data))])


def _replace(rng: random.Random, folder: Path) -> None:
    file = _file(rng, folder)
    file.write_bytes(
        rng.choice((b"", b"[]", b"{}", b"null", b"[" * 99999, rng.randbytes(500), b"PK\x03\x04" + bytes(99)))
    )


def _remove(rng: random.Random, folder: Path) -> None:
    file = _file(rng, folder)
    file.unlink()
    if rng.random() < 0.5:
        file.mkdir() if rng.random() < 0.5 else os.mkfifo(file)


def _fields(rng: random.Random, folder: Path) -> None:
    """A checkpoint that torch loads, with a field that is missing or of another kind."""
    import torch

    held = torch.load(folder / "checkpoint.pt", weights_only=True)
    place = held if rng.random() < 0.5 else held.get("state", held)
    key = rng.choice(list(place))
    if rng.random() < 0.4:
        del place[key]
    else:
        place[key] = rng.choice((None, "x", -1, 1e30, [], {}, torch.zeros(3), torch.full((96, 3), torch.nan)))
    torch.save(held, folder / "checkpoint.pt")


CHANGES: tuple[Change, ...] = (_flip, _flip, _cut, _replace, _remove, _fields, _fields)


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed."""
    for number in range(count):
        rng = random.Random(f"folder {seed} {number}")
        change = rng.choice(CHANGES)
        command = rng.choices(("resume", "again", "eval"), (6, 1, 2))[0]

        def make(folder: Path, rng: random.Random = rng, change: Change = change, command: str = command) -> list[str]:
            run = folder.parent / "run"
            shutil.copytree(_run(), run)
            change(rng, run)
            if command == "eval":
                return [
                    str(run),
                    str(_run()),
                    "--output",
                    "compared",
                    "--device",
                    "cpu",
                    "--points",
                    "100",
                    "--no-video",
                ]
            more = ["--recorder.checkpoint_every", "1"]
            return [*SMALL, *more, *(["--frames", "3", "--resume"] if command == "resume" else [])]

        name = f"{number} {change.__name__.strip('_')} {command}"
        yield Case("run folder", name, "eval" if command == "eval" else "sim", make)
