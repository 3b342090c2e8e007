"""A piece of a sweep for one process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from gaussian_swaying.runs.lock import FolderLocked

LOCKED_S = 60.0  # how long to wait for a folder: the worker of a driver that was killed ends at its frame

T = TypeVar("T")


@dataclass(frozen=True)
class Job:
    """A run to do, or several of equal shape that are simulated together.

    Args:
        folder: Folder of the sweep.
        names: Names of the runs.
        config: Configuration that all runs share, as YAML.
        frames: Frames.
        runs: The value of every axis in each run.
        device: Device of the simulation.
        attempt: 1 for the first time.
        resume: Continue from the checkpoint of an earlier attempt, if there is one; not if there are several runs.
        complete: Names of runs that are done already, and only simulated along with the others.
    """

    folder: Path
    names: tuple[str, ...]
    config: str
    frames: int
    runs: tuple[dict[str, Any], ...]
    device: str = "auto"
    attempt: int = 1
    resume: bool = True
    complete: frozenset[str] = frozenset()

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the runs without the complete ones."""
        return tuple(name for name in self.names if name not in self.complete)

    def again(self, resume: bool) -> Job:
        """The next attempt."""
        return replace(self, attempt=self.attempt + 1, resume=resume)

    def apart(self) -> list[Job]:
        """A job for each run that is not complete."""
        pairs = zip(self.names, self.runs, strict=True)
        return [replace(self, names=(n,), runs=(r,), attempt=1) for n, r in pairs if n not in self.complete]


def unlocked(work: Callable[[], T]) -> T:
    """Do what needs a folder, once it is free."""
    begin = time.monotonic()
    while True:
        try:
            return work()
        except FolderLocked:
            if time.monotonic() - begin > LOCKED_S:
                raise
            time.sleep(0.5)
