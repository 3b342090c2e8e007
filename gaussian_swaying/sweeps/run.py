"""Runs of a sweep: jobs, alone or together, their processes here or on Ray, and the loop over them."""

from __future__ import annotations

import gc
import io
import json
import os
import platform
import re
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from loky import ProcessPoolExecutor
from loky.backend import resource_tracker
from tqdm import tqdm

from gaussian_swaying._checks import check_choice, check_whole, first_line
from gaussian_swaying._files import write_json
from gaussian_swaying._provenance import cores
from gaussian_swaying.runs.lock import FolderLocked
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import POLAR, find, number
from gaussian_swaying.simulation.simulation import Simulation, run_batch
from gaussian_swaying.sweeps.dataset import (
    LOGS,
    RESULTS,
    RUNS,
    open_folder,
    read_results,
    result_of,
    write_contact_sheet,
    write_tables,
)
from gaussian_swaying.sweeps.plan import Plan, parse_run

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

KILLED = 3  # times as many retries for a job whose process was killed, as the reason may be outside of it
LOCKED_S = 60.0  # how long to wait for a folder: the worker of a driver that was killed ends at its frame
STOP_S = 300.0  # how long workers may take to write what they have when the sweep is stopped
EXTRAS = {"ray": ("ray", "ray"), "parquet": ("parquet", "pyarrow"), "shards": ("webdataset", "webdataset")}
Explain = Callable[[BaseException], str]


@dataclass(frozen=True)
class Job:
    """A run to do, or several of equal shape that are simulated together.

    ``config`` is the YAML that they share, ``runs`` have the values of the axes; runs that are ``complete`` are only
    simulated along. A single run continues from a checkpoint if it is to ``resume``.
    """

    folder: Path
    names: tuple[str, ...]
    config: str
    frames: int
    runs: tuple[Mapping[str, Any], ...]
    device: str = "auto"
    attempt: int = 1
    resume: bool = True
    complete: frozenset[str] = frozenset()

    @property
    def wanted(self) -> tuple[str, ...]:
        return tuple(name for name in self.names if name not in self.complete)


@dataclass(frozen=True)
class Outcome:
    """The result of each run of a job by name."""

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    killed: bool = False  # its process, so that the reason may be outside of it
    ready: bool = True  # for another job; not after lack of memory, a bug or a signal


@cache
def _parser() -> ArgumentParser:
    parser = Simulation.parser()
    gc.freeze()  # loky and `work` look for garbage after each run, which would take as long as a frame or two
    return parser


def work(job: Job, threads: int, explain: Explain, where: str = platform.node()) -> Outcome:
    """Do a job in a worker and write the results of its complete runs; the caller writes those of failures."""
    torch.set_num_threads(threads)
    told, status, ready = io.StringIO(), "failed", True
    try:
        with stop_signals(), redirect_stdout(told), redirect_stderr(told):
            begin, do = time.monotonic(), run_alone if len(job.names) == 1 else run_together
            while True:
                try:
                    summaries = do(job)
                    break
                except FolderLocked:
                    if time.monotonic() - begin > LOCKED_S:
                        raise
                    time.sleep(0.5)
            results = {name: result_of(summary, job.attempt, where) for name, summary in summaries.items()}
            for name, result in results.items():
                write_json(job.folder / RESULTS / f"{name}.json", result)
        return Outcome(results)
    except KeyboardInterrupt as stop:
        reason, ready = f"It was stopped ({stop or 'Ctrl-C'}).", False
    except SimulationDiverged as error:
        reason, status = first_line(error), "diverged"
    except Exception as error:
        told.write(traceback.format_exc())
        reason, ready = explain(error), isinstance(error, ValueError)
    finally:
        gc.collect()
        with suppress(OSError):
            if told.getvalue():
                with (job.folder / LOGS / f"{job.names[0]}.txt").open("a", encoding="utf-8") as file:
                    file.write(told.getvalue())
    result = {"status": status, "reason": reason, "attempts": job.attempt}
    return Outcome(dict.fromkeys(job.wanted, result), ready=ready)


def _lost(job: Job, reason: str) -> Outcome:
    """The outcome of a job whose process was killed, maybe after its last step."""
    lost = {"status": "failed", "reason": reason, "attempts": job.attempt}
    done = read_results(job.folder, job.wanted)
    found = {name: done[name] if done.get(name, lost)["status"] == "complete" else lost for name in job.wanted}
    return Outcome(found, killed=True, ready=False)


def _first_of(job: Job) -> Simulation:
    settings = parse_run(_parser(), job.config, job.frames, job.runs[0])
    settings.device = job.device
    return Simulation.from_settings(_parser(), settings)


def run_alone(job: Job) -> dict[str, dict[str, Any]]:
    """Do the only run of a job; returns its summary by name."""
    (name,), (run,) = job.names, job.runs
    folder, extra, simulation = job.folder / RUNS / name, {"sweep": {"run": name, "settings": run}}, _first_of(job)
    if job.resume and (folder / "checkpoint.pt").exists():
        try:
            return {name: simulation.run(folder, None, True, extra, progress=False)}
        except FolderLocked:
            raise
        except ValueError as error:  # it was killed after the last frame, or a file is damaged
            print(f"{error} The run starts again.")
    return {name: simulation.run(folder, None, False, extra, progress=False)}


def shares_rollout(name: str) -> bool:
    """True if runs that differ only in this axis can share a rollout, as they have the same material points."""
    known = find(name)
    return known is not None and known.batched and known.same_points and name not in POLAR and name.count(".") == 1


def grouped(runs: Sequence[Mapping[str, Any]], size: int) -> list[list[int]]:
    """Numbers of the runs that are simulated together, at most ``size`` of them; the same in a sweep that is resumed.

    Example:
        >>> grouped([{"wind.seed": 1, "solver.dx": x} for x in (1, 2, 1, 1)], 2)
        [[0, 2], [3], [1]]
    """
    alike: dict[str, list[int]] = {}
    for place, run in enumerate(runs):
        key = json.dumps({name: value for name, value in run.items() if not shares_rollout(name)})
        alike.setdefault(key, []).append(place)
    return [places[k : k + size] for places in alike.values() for k in range(0, len(places), size)]


def run_together(job: Job) -> dict[str, dict[str, Any]]:
    """Do the runs of a job in one rollout; returns the wanted summaries by name."""
    members = members_of(job)
    folders = [None if name in job.complete else job.folder / RUNS / name for name in job.names]
    extras = [{"sweep": {"run": n, "settings": r}} for n, r in zip(job.names, job.runs, strict=True)]
    summaries = run_batch(members, folders, members[0].frames_wanted, extras)
    return {name: summary for name, summary in zip(job.names, summaries, strict=True) if summary is not None}


def members_of(job: Job) -> list[Simulation]:
    """Simulations of all runs of a job; only the first is parsed, as that takes longer than a frame."""
    first = _first_of(job)
    first.start()  # with all checks of a run
    content, members = yaml.safe_load(first.config), [first]
    for run in job.runs[1:]:
        own = {name: number(name).check(name, value) for name, value in run.items() if shares_rollout(name)}
        for name, value in own.items():
            group, last = name.split(".")
            content[group][last] = value
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        members.append(first.variant(own, first.recorder, text))
    return members


class Processes:
    """Does jobs in loky's processes on this machine, which take the GPUs in turn.

    Each has an executor of its own: loky ends all processes of an executor if one of them is killed.
    """

    def __init__(self, workers: int, threads: int, explain: Explain = first_line, gpus: Sequence[str] = ()) -> None:
        self.workers, self.threads, self.explain, self.gpus = workers, threads, explain, gpus
        self._free = list(range(workers))
        self._executors: dict[int, ProcessPoolExecutor] = {}
        self._places: dict[Future[Outcome], int] = {}

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job."""
        place = self._free.pop(0)
        if place not in self._executors:
            environment = {"OMP_NUM_THREADS": str(self.threads), "GOMP_SPINCOUNT": os.getenv("GOMP_SPINCOUNT", "3000")}
            if self.gpus:
                environment["CUDA_VISIBLE_DEVICES"] = self.gpus[place % len(self.gpus)]
            self._executors[place] = ProcessPoolExecutor(1, env=environment, initializer=_end_with_parent)
        blocked = hasattr(signal, "pthread_sigmask")  # not on Windows: Ctrl-C is for the driver alone
        if blocked:
            resource_tracker.ensure_running()  # otherwise the first start does, which unblocks Ctrl-C
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            future = self._executors[place].submit(work, job, self.threads, self.explain)
        except BrokenExecutor as error:  # it was killed while it had nothing to do
            future = Future()
            future.set_exception(error)
        finally:
            if blocked:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._places[future] = place
        return future

    def outcome(self, job: Job, future: Future[Outcome]) -> Outcome:
        """The outcome of a job that has ended, however it ended."""
        place = self._places.pop(future)
        self._free.insert(0, place)
        try:
            outcome = future.result()
        except BrokenExecutor as error:
            code = (re.findall(r"\{(.*)\}", str(error)) or ["by itself"])[0]
            told = f"Its process was ended ({code}), as if memory ran out: use fewer `--workers`, or --resume."
            outcome = _lost(job, told)
        if not outcome.ready:
            self._executors.pop(place).shutdown(kill_workers=True)
        return outcome

    def close(self, stopped: bool = False) -> None:
        """End the processes; if stopped, when their jobs are at a frame, and an impatient second Ctrl-C kills them."""
        try:
            for executor in self._executors.values() if stopped else ():
                for process in list(executor._processes.values()):
                    process.terminate()
            if stopped:
                wait(self._places, STOP_S)
        finally:
            for executor in self._executors.values():
                executor.shutdown(kill_workers=stopped)


def _end_with_parent() -> None:
    parent = os.getppid()

    def watch() -> None:
        while True:  # the first signal ends a run at a frame, the next one a process without a run
            time.sleep(1.0)
            if os.getppid() != parent:
                os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


class Ray:
    """Does jobs as Ray tasks, as :class:`Processes` does, as many as there is room for if ``workers`` is None.

    All machines must have this package, and see the folder of the sweep and the splats under the same paths.
    """

    def __init__(self, address: str, workers: int | None, threads: int, explain: Explain, gpu: float) -> None:
        import ray

        self._ray: Any = ray
        self._ours = not ray.is_initialized()
        if self._ours:
            given: dict[str, Any] = {"num_cpus": workers * threads} if address == "local" and workers else {}
            try:
                ray.init(address=None if address == "local" else address, log_to_driver=False, **given)
            except (ConnectionError, RuntimeError, ValueError) as error:
                told = first_line(error)
                raise ValueError(f"There is no Ray cluster at {address} ({told}): check `--ray`.") from error
        self.workers, self._given = workers or sys.maxsize, (threads, explain, os.getcwd(), sys.path)
        # with a share of a GPU, Ray gives every task a process of its own, as a process keeps its GPU
        options = {"num_cpus": min(threads, 1), "num_gpus": gpu} if gpu else {"num_cpus": threads}
        self._task, self._options = ray.remote(_task), {"max_retries": 0, **options}
        self._references: dict[Future[Outcome], Any] = {}

    def submit(self, job: Job) -> Future[Outcome]:
        reference = self._task.options(name=f"run {job.names[0]}", **self._options).remote(job, *self._given)
        future: Future[Outcome] = reference.future()
        self._references[future] = reference
        return future

    def outcome(self, job: Job, future: Future[Outcome]) -> Outcome:
        del self._references[future]
        try:
            return future.result()
        except self._ray.exceptions.RayError as error:
            told = first_line(error)[:200]
            return _lost(job, f"Ray ended its process ({told}): use fewer `--workers` if it was memory, or --resume.")

    def close(self, stopped: bool = False) -> None:
        try:
            for reference in self._references.values() if stopped else ():
                self._ray.cancel(reference)
            if stopped:
                wait(self._references, STOP_S)
        finally:
            if self._ours:
                self._ray.shutdown()


def _task(job: Job, threads: int, explain: Explain, folder: str, path: list[str]) -> Outcome:
    import ray

    os.chdir(folder)
    sys.path[:] = [*sys.path, *(entry for entry in path if entry not in sys.path)]
    done = work(job, threads, explain, f"{platform.node()} {ray.get_runtime_context().get_node_id()[:8]}")
    if not done.ready:  # Ray would give it another job: it ends once the result is on its way
        threading.Timer(1.0, os._exit, (0,)).start()
    return done


def drive(
    jobs: Sequence[Job], pool: Processes | Ray, ended: Callable[[str, dict[str, Any]], None], retries: int = 1
) -> None:
    """Run jobs: a failed one is tried again, and one that fails too often does not stop the rest.

    A job of several runs that fails is done again run by run. ``ended`` gets the name and the result of each run; if
    this is interrupted, they are ended in order.
    """
    waiting, running = deque(jobs), dict[Future[Outcome], Job]()
    try:
        while waiting or running:
            while waiting and len(running) < pool.workers:
                job = waiting.popleft()
                running[pool.submit(job)] = job
            for future in wait(running, 1.0, FIRST_COMPLETED).done:
                job = running.pop(future)
                outcome, several = pool.outcome(job, future), len(job.names) > 1
                failed = any(result["status"] != "complete" for result in outcome.results.values())
                if failed and job.attempt <= retries * (KILLED if outcome.killed else 0 if several else 1):
                    # from the checkpoint, unless that has been tried
                    again = outcome.killed or job.attempt == 1
                    waiting.append(replace(job, attempt=job.attempt + 1, resume=again))
                elif failed and several:
                    alone = ((n, r) for n, r in zip(job.names, job.runs, strict=True) if n in job.wanted)
                    waiting.extend(replace(job, names=(n,), runs=(r,), attempt=1) for n, r in alone)
                else:
                    for name in job.wanted:
                        ended(name, outcome.results[name])
    except BaseException:
        pool.close(stopped=True)
        raise
    pool.close()


def run_sweep(
    plan: Plan,
    output: str | os.PathLike[str],
    resume: bool = False,
    workers: int | None = None,
    threads: int | None = None,
    retries: int = 1,
    device: str = "auto",
    explain: Explain = first_line,
    progress: bool = True,
    together: int = 1,
    ray: str | None = None,
    parquet: bool = False,
) -> dict[str, dict[str, Any]]:
    """Do all runs of a sweep that are not complete yet.

    Args:
        workers: Runs at a time; None for one on each GPU, or core.
        threads: Threads of each; None for its share of the cores.
        retries: Number of times that a failed run is tried again; three times as often if its process was killed.
        explain: Makes a sentence of an error of a run; a function of a module.
        together: Largest number of runs of equal shape that are simulated together, as one job.
        ray: Address of a Ray cluster, or ``local`` to start Ray here; None for processes of this machine.

    Returns:
        The result of every run by name, as in ``results/``.
    """
    folder = Path(output).absolute()
    check_choice("device", device, ("auto", "cpu", "cuda"))
    for name, given in (("retries", retries), ("workers", workers), ("threads", threads), ("together", together)):
        if given is not None:
            check_whole(name, given, 0 if name == "retries" else 1)
    for option in (["ray"] if ray is not None else []) + (["parquet"] if parquet else []):
        check_extra(option)
    with open_folder(folder, plan, resume, together):
        results = read_results(folder, plan.names)
        done = frozenset(name for name, result in results.items() if result["status"] == "complete")
        jobs = []
        for group in grouped(plan.runs, together):
            names, runs = tuple(plan.names[k] for k in group), tuple(plan.runs[k] for k in group)
            if not done.issuperset(names):
                own = done.intersection(names)
                jobs.append(Job(folder, names, plan.config, plan.frames, runs, device, complete=own))
        bar = tqdm(total=len(plan.runs), initial=len(done), unit="run", disable=not progress, file=sys.stderr)

        def ended(name: str, result: dict[str, Any]) -> None:
            results[name] = result
            if result["status"] != "complete":  # a complete run has written its own
                with suppress(OSError):  # a full disk
                    write_json(folder / RESULTS / f"{name}.json", result)
                if progress:
                    tqdm.write(f"run {name} {result['status']}: {result['reason']}", file=sys.stderr)
            bar.update()

        count = 0 if device == "cpu" else torch.cuda.device_count()
        named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
        gpus = named[:count] or [str(place) for place in range(count)]
        try:
            if jobs and ray is not None:
                share = min(1.0, len(gpus) / (workers or 1)) or float(device == "cuda")
                drive(jobs, Ray(ray, workers, threads or 1, explain, share), ended, retries)
            elif jobs:
                workers = workers or len(gpus) or cores()
                threads = threads or max(1, cores() // min(workers, len(jobs)))
                drive(jobs, Processes(workers, threads, explain, gpus), ended, retries)
        finally:
            bar.close()
            results |= read_results(folder, plan.names)  # some may have ended while the sweep was being stopped
            write_tables(folder, plan, results, parquet)
        write_contact_sheet(folder, plan, results)
        return results


def check_extra(option: str) -> None:
    """Raise ValueError if an option of the command needs a module that is not installed."""
    extra, module = EXTRAS[option]
    if find_spec(module) is None:
        raise ValueError(f"`--{option}` needs {module}: install gaussian-swaying[{extra}], or leave it out.")
