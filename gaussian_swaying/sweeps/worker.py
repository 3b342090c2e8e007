"""A worker: a process that does one job after the other, and ends with the process that started it."""

from __future__ import annotations

import gc
import io
import os
import platform
import signal
import threading
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from multiprocessing import connection as connections
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import torch

from gaussian_swaying._checks import first_line
from gaussian_swaying._files import write_json
from gaussian_swaying.runs.lock import FolderLocked
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.backend import Job, Outcome, unlocked
from gaussian_swaying.sweeps.plan import parse_run
from gaussian_swaying.sweeps.record import LOGS, RUNS, failure, result_file, result_of
from gaussian_swaying.sweeps.together import run_together

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

CONTEXT_BYTES = 700 << 20  # what CUDA, its libraries and the compiled kernels take besides torch's allocator
WHERE = "GAUSSIAN_SWAYING_WHERE"
"""Variable of the environment with a name for the place of a worker; the host if it is not set."""

Explain = Callable[[BaseException], str]


def work(connection: Connection, threads: int, explain: Explain = first_line) -> None:
    """Do the jobs that arrive, and send the result of each; ends after a failure that may have left something behind.

    Args:
        connection: Receives jobs and sends results.
        threads: Threads of torch.
        explain: Makes a sentence of an error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the driver ends this one by SIGTERM
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    with suppress(KeyboardInterrupt, EOFError, OSError), stop_signals():
        parser = Simulation.parser()
        while True:
            done = do(connection.recv(), parser, explain)
            connection.send(done)
            if not done.ready:
                return
            gc.collect()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connections.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def do(job: Job, parser: ArgumentParser, explain: Explain) -> Outcome:
    """Do a job and write the results of its complete runs.

    Args:
        job: The job.
        parser: From :meth:`Simulation.parser`.
        explain: Makes a sentence of an error.

    Returns:
        The results; those of failures are not written yet.
    """
    told = io.StringIO()
    try:
        with redirect_stdout(told), redirect_stderr(told):
            summaries = _run(job, parser) if len(job.names) == 1 else run_together(job, parser)
            results = {name: result_of(summary, job.attempt, _where()) for name, summary in summaries.items()}
            for name, result in results.items():
                write_json(result_file(job.folder, name), result)
        return Outcome(results, share=_share())
    except KeyboardInterrupt as stop:
        return _failed(job, "failed", f"It was stopped ({stop or 'Ctrl-C'}).", False)
    except SimulationDiverged as error:
        return _failed(job, "diverged", first_line(error), True)
    except Exception as error:
        told.write(traceback.format_exc())
        return _failed(job, "failed", explain(error), isinstance(error, ValueError))
    finally:
        with suppress(OSError):
            if told.getvalue():
                with (job.folder / LOGS / f"{job.names[0]}.txt").open("a", encoding="utf-8") as file:
                    file.write(told.getvalue())


def _failed(job: Job, status: str, reason: str, ready: bool) -> Outcome:
    return Outcome({name: failure(status, reason, job.attempt) for name in job.wanted}, ready=ready)


def _where() -> str:
    return os.environ.get(WHERE) or platform.node()


def _share() -> float | None:
    if not torch.cuda.is_initialized():
        return None
    return (torch.cuda.max_memory_reserved() + CONTEXT_BYTES) / torch.cuda.get_device_properties(0).total_memory


def _run(job: Job, parser: ArgumentParser) -> dict[str, dict[str, Any]]:
    """Do the only run of a job; its summary by its name."""
    (name,), (run,) = job.names, job.runs
    settings = parse_run(parser, job.config, job.frames, run)
    settings.device = job.device
    folder = job.folder / RUNS / name
    extra = {"sweep": {"run": name, "settings": run}}
    simulation = Simulation.from_settings(parser, settings)

    def once() -> dict[str, Any]:
        if job.resume and (folder / "checkpoint.pt").exists():
            try:
                return simulation.run(folder, None, True, extra, progress=False)
            except FolderLocked:
                raise
            except ValueError as error:  # it was killed after the last frame, or a file is damaged
                print(f"{error} The run starts again.")
        return simulation.run(folder, None, False, extra, progress=False)

    return {name: unlocked(once)}
