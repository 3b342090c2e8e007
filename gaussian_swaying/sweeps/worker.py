"""A worker: a process that does one run after the other, and ends with the process that started it."""

from __future__ import annotations

import gc
import io
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection as connections
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gaussian_swaying._files import write_json
from gaussian_swaying.runs.lock import FolderLocked
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.plan import parse_run
from gaussian_swaying.sweeps.record import LOGS, RUNS, failure, result_file, result_of

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

LOCKED_S = 60.0  # how long to wait for a folder: the worker of a driver that was killed ends at its frame

Explain = Callable[[BaseException], str]


@dataclass(frozen=True)
class Job:
    """A run to do.

    Args:
        folder: Folder of the sweep.
        name: Name of the run.
        config: What all runs share, as YAML.
        frames: Frames.
        run: The value of every axis.
        device: Where to simulate.
        attempt: 1 for the first time.
        resume: Continue from the checkpoint of an earlier attempt, if there is one.
    """

    folder: Path
    name: str
    config: str
    frames: int
    run: dict[str, Any]
    device: str = "auto"
    attempt: int = 1
    resume: bool = True

    def again(self, resume: bool) -> Job:
        """The next attempt."""
        return replace(self, attempt=self.attempt + 1, resume=resume)


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or the name of the error."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def work(connection: Connection, threads: int, explain: Explain = first_line) -> None:
    """Do the jobs that arrive, and send the result of each; ends after a failure that may have left something behind.

    Args:
        connection: Where jobs come from and results go to.
        threads: Threads of torch.
        explain: Makes a sentence of an error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the driver ends this one by SIGTERM
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    with suppress(KeyboardInterrupt, EOFError, OSError), stop_signals():
        parser = Simulation.parser()
        while True:
            result, ready = do(connection.recv(), parser, explain)
            connection.send((result, ready))
            if not ready:
                return
            gc.collect()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connections.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def do(job: Job, parser: ArgumentParser, explain: Explain) -> tuple[dict[str, Any], bool]:
    """Do a run and write its result, if it is complete.

    Args:
        job: The run.
        parser: From :meth:`Simulation.parser`.
        explain: Makes a sentence of an error.

    Returns:
        Its result, which is not written yet if it is a failure; and whether this process can do another run. It should
        not after lack of memory, a bug or a signal.
    """
    told = io.StringIO()
    try:
        with redirect_stdout(told), redirect_stderr(told):
            result = result_of(_run(job, parser), job.attempt)
            write_json(result_file(job.folder, job.name), result)
        return result, True
    except KeyboardInterrupt as stop:
        return failure("failed", f"It was stopped ({stop or 'Ctrl-C'}).", job.attempt), False
    except SimulationDiverged as error:
        return failure("diverged", first_line(error), job.attempt), True
    except Exception as error:
        told.write(traceback.format_exc())
        return failure("failed", explain(error), job.attempt), isinstance(error, ValueError)
    finally:
        with suppress(OSError):
            if told.getvalue():
                with (job.folder / LOGS / f"{job.name}.txt").open("a", encoding="utf-8") as file:
                    file.write(told.getvalue())


def _run(job: Job, parser: ArgumentParser) -> dict[str, Any]:
    settings = parse_run(parser, job.config, job.frames, job.run)
    settings.device = job.device
    folder = job.folder / RUNS / job.name
    extra = {"sweep": {"run": job.name, "settings": job.run}}
    simulation = Simulation.from_settings(parser, settings)
    begin = time.monotonic()
    while True:
        try:
            if job.resume and (folder / "checkpoint.pt").exists():
                try:
                    return simulation.run(folder, settings.frames, True, extra, progress=False)
                except FolderLocked:
                    raise
                except ValueError as error:  # it was killed after the last frame, or a file is damaged
                    print(f"{error} The run starts again.")
            return simulation.run(folder, settings.frames, False, extra, progress=False)
        except FolderLocked:
            if time.monotonic() - begin > LOCKED_S:
                raise
            time.sleep(0.5)


__all__ = ["Explain", "Job", "do", "first_line", "work"]
