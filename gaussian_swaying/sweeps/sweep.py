"""A whole sweep: what is missing is done by worker processes, and the table and the contact sheet show all."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from gaussian_swaying._checks import check_choice
from gaussian_swaying._files import write_json
from gaussian_swaying.sweeps.contact_sheet import PICTURES, write_contact_sheets
from gaussian_swaying.sweeps.plan import Plan
from gaussian_swaying.sweeps.pool import run_jobs
from gaussian_swaying.sweeps.record import open_folder, read_result, result_file, write_tables
from gaussian_swaying.sweeps.worker import Explain, Job, first_line

TABLE_EVERY_S = 5.0


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpus_for(device: str) -> list[str]:
    """The GPUs for runs on a device, as in ``CUDA_VISIBLE_DEVICES``; none on a CPU.

    Args:
        device: ``auto``, ``cpu`` or ``cuda``.
    """
    if device == "cpu" or not torch.cuda.is_available():
        return []
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return named[: torch.cuda.device_count()] or [str(number) for number in range(torch.cuda.device_count())]


def run_sweep(
    plan: Plan,
    output: str | os.PathLike[str],
    *,
    resume: bool = False,
    workers: int | None = None,
    threads: int | None = None,
    retries: int = 1,
    device: str = "auto",
    picture: str = "last",
    explain: Explain = first_line,
    progress: bool = True,
    started: Callable[[], None] = lambda: None,
) -> dict[str, dict[str, Any]]:
    """Do the runs of a sweep that are not complete yet.

    Call it from a module that can be imported (under ``if __name__ == "__main__":`` in a script), as the workers are
    started by spawn.

    Args:
        plan: From :func:`~gaussian_swaying.sweeps.plan.make_plan`.
        output: Folder of the sweep.
        resume: Continue the sweep in the folder; complete runs are never done again.
        workers: Runs at a time, each in a process; one per GPU, or per core without one, if None.
        threads: Threads of each; cores / workers if None.
        retries: How often a failed run is tried again; three times as often if its process was killed.
        device: ``auto``, ``cpu`` or ``cuda``, for every run.
        picture: Frame of the contact sheet, ``last`` or ``middle``.
        explain: Makes a sentence of an error of a run; a function of a module.
        progress: Show a bar of runs, and a line for each failure.
        started: Called when the folder is locked and the first run is about to begin.

    Returns:
        The result of every run by name, as in ``results/``.

    Raises:
        FolderLocked: If another sweep writes to the folder.
        ValueError: If the folder holds something else, or a sweep with other settings.
        OSError: If a table could not be written, after all runs.
    """
    folder = Path(output)
    check_choice("picture", picture, PICTURES)
    for name, count, least in (("workers", workers, 1), ("threads", threads, 1), ("retries", retries, 0)):
        if count is not None and count < least:
            raise ValueError(f"Expected `{name}` to be at least {least}, but got {count}.")
    check_choice("device", device, ("auto", "cpu", "cuda"))
    gpus = gpus_for(device)
    workers = workers or len(gpus) or cores()
    threads = threads or max(1, cores() // workers)
    lock = open_folder(folder, plan, resume)
    try:
        started()
        found = {name: result for name in plan.names if (result := read_result(folder, name)) is not None}
        keeper = _Keeper(folder, plan, found, progress)
        jobs = [
            Job(folder, name, plan.config, plan.frames, dict(run), device)
            for name, run in zip(plan.names, plan.runs, strict=True)
            if name not in found or found[name]["status"] != "complete"
        ]
        try:
            run_jobs(jobs, workers, threads, keeper.ended, retries, explain, keeper.tick, gpus)
        finally:
            keeper.close()
        write_contact_sheets(folder, picture)
        return keeper.results
    finally:
        lock.release()


class _Keeper:
    """Keeps the results of a sweep: files, tables and the bar."""

    def __init__(self, folder: Path, plan: Plan, results: dict[str, dict[str, Any]], progress: bool) -> None:
        self.folder, self.plan, self.results, self.progress = folder, plan, results, progress
        self.unwritten: dict[str, dict[str, Any]] = {}
        done = sum(result["status"] == "complete" for result in results.values())
        self._terminal = sys.stderr.isatty()
        pause = 0.1 if self._terminal else 10.0  # s; a log need not grow every second
        self._bar = tqdm(
            total=len(plan.runs), initial=done, unit="run", disable=not progress, file=sys.stderr, mininterval=pause
        )
        self._written = time.monotonic()
        self.write()

    def ended(self, job: Job, result: dict[str, Any]) -> None:
        """A run is complete, or has failed for good."""
        self.results[job.name] = result
        if result["status"] != "complete":  # a complete run has written its own
            self.unwritten[job.name] = result
            if self.progress:
                tqdm.write(f"run {job.name} {result['status']}: {result['reason']}", file=sys.stderr)
        self._bar.update()
        if time.monotonic() - self._written > TABLE_EVERY_S:
            try:
                self.write()
            except OSError as error:  # a full disk must not stop the rest; it is tried again
                if self.progress:
                    tqdm.write(f"warning: the table could not be written ({error.strerror or error}).", file=sys.stderr)

    def tick(self, running: int) -> None:
        """Show what is going on."""
        counts = Counter(result["status"] for result in self.results.values())
        shown = [f"{running} running", *(f"{counts[name]} {name}" for name in ("failed", "diverged") if counts[name])]
        self._bar.set_postfix_str(", ".join(shown), refresh=self._terminal)

    def write(self) -> None:
        """Write the results of failed runs, and the tables."""
        self._written = time.monotonic()
        for name in list(self.unwritten):
            write_json(result_file(self.folder, name), self.unwritten[name])
            del self.unwritten[name]
        write_tables(self.folder, self.plan.names, self.plan.runs, self.results)

    def close(self) -> None:
        """The sweep is over, or was stopped."""
        self._bar.close()
        for name in self.plan.names:  # runs that were completed while the sweep was being stopped
            result = read_result(self.folder, name)
            if result is not None and name not in self.unwritten:
                self.results[name] = result
        self.write()


__all__ = ["cores", "run_sweep"]
