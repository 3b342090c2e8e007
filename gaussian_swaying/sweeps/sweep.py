"""A whole sweep: a backend does the missing runs, and the table and the contact sheet show all."""

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

from gaussian_swaying._checks import check_choice, first_line
from gaussian_swaying._files import write_json
from gaussian_swaying._provenance import cores
from gaussian_swaying.runs.lock import FolderLock, FolderLocked
from gaussian_swaying.sweeps.backend import Backend, Job, drive
from gaussian_swaying.sweeps.contact_sheet import PICTURES, write_contact_sheets
from gaussian_swaying.sweeps.plan import Plan
from gaussian_swaying.sweeps.pool import Pool
from gaussian_swaying.sweeps.ray_backend import LOCAL, RayBackend, check_ray
from gaussian_swaying.sweeps.record import (
    check_parquet,
    open_folder,
    read_result,
    result_file,
    write_parquet,
    write_tables,
)
from gaussian_swaying.sweeps.together import grouped
from gaussian_swaying.sweeps.worker import Explain

TABLE_EVERY_S = 5.0


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
    together: int = 1,
    per_gpu: int | None = 1,
    ray: str | None = None,
    part: tuple[int, int] | None = None,
    parquet: bool = False,
) -> dict[str, dict[str, Any]]:
    """Do the runs of a sweep that are not complete yet.

    Call it from a module that can be imported (under ``if __name__ == "__main__":`` in a script), as the workers are
    started by spawn.

    Args:
        plan: From :func:`~gaussian_swaying.sweeps.plan.make_plan`.
        output: Folder of the sweep.
        resume: Continue the sweep in the folder; complete runs are never done again.
        workers: Jobs at a time, each in a process; if None, ``per_gpu`` for each GPU, or one per core without one.
        threads: Threads of each; cores / workers if None, and 1 with ``ray``.
        retries: Number of times that a failed run is tried again; three times as often if its process was killed.
        device: ``auto``, ``cpu`` or ``cuda``, for every run.
        picture: Frame of the contact sheet, ``last`` or ``middle``.
        explain: Makes a sentence of an error of a run; a function of a module.
        progress: Show a bar of runs, and a line for each failure.
        started: Called when the folder is locked and the first run is about to begin.
        together: Largest number of runs of equal shape that are simulated together, as one job.
        per_gpu: Jobs per GPU; None for as many as fit into its memory, by what the first ones took.
        ray: Address of a Ray cluster, or ``local`` to start Ray here; None for processes of this machine.
        part: Number of the part to do, from 1, and how many parts there are; None for all. The others may be done at
            the same time in the same folder. The part that ends last writes the table and the contact sheet.
        parquet: Also write ``sweep.parquet``.

    Returns:
        The result of every run (of this part) by name, as in ``results/``.
    """
    folder = Path(output).absolute()
    check_choice("picture", picture, PICTURES)
    counts = {"workers": workers, "threads": threads, "retries": retries, "together": together, "per_gpu": per_gpu}
    for name, count in counts.items():
        if count is not None and count < (name != "retries"):
            raise ValueError(f"Expected `{name}` to be at least {int(name != 'retries')}, but got {count}.")
    if part is not None and not 1 <= part[0] <= part[1]:
        raise ValueError(
            f"Expected `part` to be one of 1/{part[1]} to {part[1]}/{part[1]}, but got {part[0]}/{part[1]}."
        )
    check_choice("device", device, ("auto", "cpu", "cuda"))
    if parquet:
        check_parquet()
    if ray is not None:
        check_ray()
    lock = open_folder(folder, plan, resume, together, part)
    try:
        started()
        groups = [[plan.names[number] for number in group] for group in grouped(plan.runs, together)]
        if part is not None:
            groups = groups[part[0] - 1 :: part[1]]
        mine = [name for group in groups for name in group]
        earlier = {name: result for name in mine if (result := read_result(folder, name)) is not None}
        keeper = _Keeper(folder, plan, mine, earlier, progress, part is None)
        jobs = _jobs(folder, plan, groups, earlier, device)
        try:
            if jobs:
                backend = _backend(ray, workers, threads, explain, device, per_gpu, len(jobs))
                drive(jobs, backend, keeper.ended, retries, keeper.tick)
        finally:
            keeper.close()
        if part is None:
            _finish(folder, plan, keeper.results, picture, parquet)
        else:
            _finish_parts(folder, plan, picture, parquet)
        return keeper.results
    finally:
        lock.release()


def _jobs(folder: Path, plan: Plan, groups: list[list[str]], earlier: dict[str, Any], device: str) -> list[Job]:
    runs = dict(zip(plan.names, plan.runs, strict=True))
    jobs = []
    for names in groups:
        complete = frozenset(name for name in names if name in earlier and earlier[name]["status"] == "complete")
        if len(complete) < len(names):
            own = tuple(dict(runs[name]) for name in names)
            jobs.append(Job(folder, tuple(names), plan.config, plan.frames, own, device, complete=complete))
    return jobs


def _backend(
    ray: str | None,
    workers: int | None,
    threads: int | None,
    explain: Explain,
    device: str,
    per_gpu: int | None,
    jobs: int,
) -> Backend:
    if ray is not None:
        on_gpu = device == "cuda" or (device == "auto" and bool(gpus_for(device)))
        return RayBackend(ray or LOCAL, workers, threads or 1, explain, on_gpu, per_gpu)
    gpus = gpus_for(device)
    first = workers or len(gpus) * (per_gpu or 1) or cores()
    most = None if workers or per_gpu or not gpus else max(cores(), len(gpus))
    threads = threads or max(1, cores() // min(most or first, max(jobs, 1)))
    return Pool(first, threads, explain, gpus, most)


def _finish(folder: Path, plan: Plan, results: dict[str, dict[str, Any]], picture: str, parquet: bool) -> None:
    if parquet:
        write_parquet(folder, plan.names, plan.runs, results)
    write_contact_sheets(folder, picture)


def _finish_parts(folder: Path, plan: Plan, picture: str, parquet: bool) -> None:
    """Write the tables and contact sheets once all parts have ended; if two end at once, only one writes."""
    results = {name: result for name in plan.names if (result := read_result(folder, name)) is not None}
    if len(results) < len(plan.names):
        return
    try:
        lock = FolderLock(folder)
    except FolderLocked:
        return
    try:
        write_tables(folder, plan.names, plan.runs, results)
        _finish(folder, plan, results, picture, parquet)
    finally:
        lock.release()


class _Keeper:
    """Keeps the results of a sweep, or of a part of it: files, tables and the bar."""

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        names: list[str],
        results: dict[str, dict[str, Any]],
        progress: bool,
        tables: bool,
    ) -> None:
        self.folder, self.plan, self.names, self.results, self.progress = folder, plan, names, results, progress
        self.tables = tables
        self.unwritten: dict[str, dict[str, Any]] = {}
        done = sum(result["status"] == "complete" for result in results.values())
        self._terminal = sys.stderr.isatty()
        pause = 0.1 if self._terminal else 10.0  # s; a log need not grow every second
        self._bar = tqdm(
            total=len(names), initial=done, unit="run", disable=not progress, file=sys.stderr, mininterval=pause
        )
        self._written = time.monotonic()
        self.write()

    def ended(self, name: str, result: dict[str, Any]) -> None:
        self.results[name] = result
        if result["status"] != "complete":  # a complete run has written its own
            self.unwritten[name] = result
            if self.progress:
                tqdm.write(f"run {name} {result['status']}: {result['reason']}", file=sys.stderr)
        self._bar.update()
        if time.monotonic() - self._written > TABLE_EVERY_S:
            try:
                self.write()
            except OSError as error:  # a full disk must not stop the rest; it is tried again
                if self.progress:
                    tqdm.write(f"warning: the table could not be written ({error.strerror or error}).", file=sys.stderr)

    def tick(self, running: int) -> None:
        counts = Counter(result["status"] for result in self.results.values())
        shown = [f"{running} running", *(f"{counts[name]} {name}" for name in ("failed", "diverged") if counts[name])]
        self._bar.set_postfix_str(", ".join(shown), refresh=self._terminal)

    def write(self) -> None:
        self._written = time.monotonic()
        for name in list(self.unwritten):
            write_json(result_file(self.folder, name), self.unwritten[name])
            del self.unwritten[name]
        if self.tables:
            write_tables(self.folder, self.plan.names, self.plan.runs, self.results)

    def close(self) -> None:
        self._bar.close()
        for name in self.names:  # runs that were completed while the sweep was being stopped
            result = read_result(self.folder, name)
            if result is not None and name not in self.unwritten:
                self.results[name] = result
        self.write()
