"""Runs of a sweep: jobs, alone or together, their processes here or on Ray, and the loop over them."""

from __future__ import annotations

import gc
import io
import itertools
import json
import os
import platform
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from multiprocessing import connection as connections
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch
from tqdm import tqdm

from gaussian_swaying._checks import check_choice, first_line
from gaussian_swaying._files import write_json
from gaussian_swaying._provenance import cores
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.runs.lock import FolderLock, FolderLocked
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.model import POLAR, find, in_settings, names
from gaussian_swaying.simulation.simulation import Simulation, run_batch
from gaussian_swaying.sweeps.dataset import PICTURES, write_contact_sheets
from gaussian_swaying.sweeps.plan import Plan, parse_run
from gaussian_swaying.sweeps.record import (
    LOGS,
    RUNS,
    check_parquet,
    failure,
    open_folder,
    read_result,
    result_file,
    result_of,
    write_parquet,
    write_tables,
)

POLL_S = 1.0
KILLED = 3  # times as many retries for a job whose process was killed, as the reason may be outside of it
LOCKED_S = 60.0  # how long to wait for a folder: the worker of a driver that was killed ends at its frame
PACKED = 0.9  # share of a GPU's memory that is given away, as runs differ
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
        return replace(self, attempt=self.attempt + 1, resume=resume)

    def apart(self) -> list[Job]:
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


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        results: The result of each of its runs, by name.
        killed: Whether its process was killed, so that the reason may be outside of it.
        share: Share of the memory of its GPU that it took; None on a CPU, or if it is not known.
        ready: Whether its process can do another job. It should not after lack of memory, a bug or a signal.
    """

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    killed: bool = False
    share: float | None = None
    ready: bool = True

    @property
    def complete(self) -> bool:
        return all(result["status"] == "complete" for result in self.results.values())


class Backend(Protocol):
    """Does jobs, several at a time. It knows nothing of plans, retries and tables."""

    def free(self) -> bool:
        """True if another job can be given."""

    def submit(self, job: Job) -> None:
        """Begin a job."""

    def wait(self, seconds: float) -> list[tuple[Job, Outcome]]:
        """Return the jobs that have ended; wait for one, at most so many seconds."""

    def pack(self, share: float) -> None:
        """Learn the share of a GPU's memory that a job needs."""

    def stop(self) -> None:
        """Let all jobs end in order, at a frame."""

    def close(self) -> None:
        """Release all resources; no more jobs follow."""


def drive(
    jobs: Sequence[Job],
    backend: Backend,
    ended: Callable[[str, dict[str, Any]], None],
    retries: int = 1,
    tick: Callable[[int], None] = lambda running: None,
) -> None:
    """Run jobs: a failed one is tried again, and one that fails too often does not stop the rest.

    A job of several runs that fails is done again run by run. If this is interrupted (Ctrl-C, or an exception of a
    callback), the runs are ended in order.

    Args:
        jobs: The jobs.
        backend: Does them.
        ended: Called with the name and the result of each run, in the order in which they end.
        retries: Number of times that a failed job is tried again; three times as often if its process was killed.
        tick: Called about once a second with the number of runs that are being done.
    """
    waiting, running = deque(jobs), 0
    try:
        while waiting or running:
            while waiting and backend.free():
                job = waiting.popleft()
                backend.submit(job)
                running += len(job.names)
            for job, outcome in backend.wait(POLL_S):
                running -= len(job.names)
                if outcome.share is not None:
                    backend.pack(outcome.share)
                several = len(job.names) > 1
                limit = retries * (KILLED if outcome.killed else 0 if several else 1)
                if not outcome.complete and job.attempt <= limit:
                    # from the checkpoint, unless that has been tried
                    waiting.append(job.again(resume=outcome.killed or job.attempt == 1))
                elif not outcome.complete and several:
                    waiting.extend(job.apart())
                else:
                    for name in job.wanted:
                        ended(name, outcome.results[name])
            tick(running)
    except BaseException:
        backend.stop()
        raise
    backend.close()


def lost(job: Job, reason: str) -> Outcome:
    """The outcome of a job whose process was killed.

    Args:
        job: The job.
        reason: One sentence.
    """
    written = {name: read_result(job.folder, name) for name in job.wanted}
    results = {  # it may have been killed after its last step
        name: result if result and result["status"] == "complete" else failure("failed", reason, job.attempt)
        for name, result in written.items()
    }
    return Outcome(results, killed=True, ready=False)


if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

OPTIONS = [name for name in names() if name not in POLAR and "*" not in name]
"""Parameters that are options of ``sim``."""


def shares_rollout(name: str) -> bool:
    """True if runs that differ only in this axis can share a rollout, as they have the same material points."""
    known = find(name)
    return known is not None and known.batched and known.same_points and name in OPTIONS


def grouped(runs: Sequence[Mapping[str, Any]], size: int) -> list[list[int]]:
    """Numbers of the runs that are simulated together, at most ``size`` of them.

    It depends on nothing but the runs and the size, so that a sweep that is resumed has the same groups.

    Args:
        runs: The value of every axis in each run.
        size: Largest number of runs in a group.

    Example:
        >>> grouped([{"wind.seed": 1, "solver.dx": x} for x in (1, 2, 1, 1)], 2)
        [[0, 2], [3], [1]]
    """
    alike: dict[str, list[int]] = {}
    for number, run in enumerate(runs):
        key = json.dumps({name: value for name, value in run.items() if not shares_rollout(name)})
        alike.setdefault(key, []).append(number)
    return [numbers[k : k + size] for numbers in alike.values() for k in range(0, len(numbers), size)]


def run_together(job: Job, parser: ArgumentParser) -> dict[str, dict[str, Any]]:
    """Do the runs of a job in one rollout.

    Args:
        job: The job.
        parser: From :meth:`Simulation.parser`.

    Returns:
        The summaries of its runs by name, without those that are complete.
    """
    members, frames = members_of(job, parser)
    folders = [None if name in job.complete else job.folder / RUNS / name for name in job.names]
    extras = [{"sweep": {"run": n, "settings": r}} for n, r in zip(job.names, job.runs, strict=True)]
    summaries = unlocked(lambda: run_batch(members, folders, frames, extras))
    return {name: summary for name, summary in zip(job.names, summaries, strict=True) if summary is not None}


def members_of(job: Job, parser: ArgumentParser) -> tuple[list[Simulation], int]:
    """The simulations of all runs of a job, and how many frames they have."""
    settings = [parse_run(parser, job.config, job.frames, job.runs[0])]
    settings[0].device = job.device
    changes: list[dict[str, Any]] = [{}]
    for run in job.runs[1:]:  # parsing takes longer than a frame of all
        settings.append(settings[0].clone())
        changes.append({name: value for name, value in run.items() if shares_rollout(name)})
        in_settings(settings[-1], changes[-1])
    first = Simulation.from_settings(parser, settings[0])
    first.start()  # with all checks of a run
    written = texts(parser, settings, [name for name in job.runs[0] if shares_rollout(name)])
    members = [first]
    for one, own, text in zip(settings[1:], changes[1:], written[1:], strict=True):
        members.append(first.variant(own, parser.instantiate(one).recorder, text))
    return members, settings[0].frames


def texts(parser: ArgumentParser, settings: Sequence[Namespace], options: Sequence[str]) -> list[str]:
    """The configuration of each run as YAML, as :func:`~gaussian_swaying.config.parser.config_text` writes it.

    The parser takes longer for one than a GPU takes for a frame of all, so it writes the first one, and the values that
    differ are put in.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: Of each run.
        options: Those in which they differ.
    """
    import yaml

    def written(content: dict[str, Any]) -> str:
        return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))

    first = config_text(parser, settings[0])
    content = yaml.safe_load(first)
    if written(content) != first:  # another version of the parser writes it in another way
        return [config_text(parser, one) for one in settings]
    configs = []
    for one in settings:
        for group, last in (name.split(".") for name in options):
            content[group][last] = one[group][last]
        configs.append(written(content))
    return configs


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


PATIENCE_S = 300.0  # how long a worker may take to write what it has when the sweep is stopped


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    place: int  # among those that run at the same time
    job: Job | None = None


class Pool:
    """A :class:`Backend` of processes, which are started when they are needed.

    Args:
        workers: Processes at a time.
        threads: Threads of torch in each.
        explain: Makes a sentence of an error; a function of a module, as it is called in the workers.
        gpus: The GPUs as in ``CUDA_VISIBLE_DEVICES``; the workers take them in turn.
        most: Processes at a time once the memory of a job on a GPU is known; ``workers`` if None.
    """

    def __init__(
        self,
        workers: int,
        threads: int,
        explain: Explain = first_line,
        gpus: Sequence[str] = (),
        most: int | None = None,
    ) -> None:
        self.workers, self.threads, self.explain, self.gpus, self.most = workers, threads, explain, gpus, most
        self._workers: list[_Worker] = []
        self._share = 0.0

    def free(self) -> bool:
        """See ``Backend.free``."""
        return sum(worker.job is not None for worker in self._workers) < self.workers

    def submit(self, job: Job) -> None:
        """See ``Backend.submit``."""
        idle = next((worker for worker in self._workers if worker.job is None), None) or self._hire()
        idle.job = job
        with suppress(OSError):  # it was killed while it had nothing to do; `_receive` notices
            idle.connection.send(job)

    def wait(self, seconds: float) -> list[tuple[Job, Outcome]]:
        """See ``Backend.wait``."""
        busy = [worker for worker in self._workers if worker.job is not None]
        ready = connections.wait([worker.connection for worker in busy], seconds)
        ended = []
        for worker in (worker for worker in busy if worker.connection in ready):
            job, worker.job = worker.job, None
            assert job is not None
            outcome = _receive(worker, job)
            if not outcome.ready:
                _dismiss(worker)
                self._workers.remove(worker)
            ended.append((job, outcome))
        return ended

    def pack(self, share: float) -> None:
        """See ``Backend.pack``: as many processes to a GPU as fit into its memory, by the largest job so far."""
        if self.most is not None and self.gpus and share > self._share:
            self._share = share
            self.workers = min(self.most, len(self.gpus) * max(1, int(PACKED / share)))

    def close(self) -> None:
        """See ``Backend.close``."""
        for worker in self._workers:
            _dismiss(worker)

    def stop(self) -> None:
        """Let all workers end their runs at a frame; an impatient second Ctrl-C kills them."""
        try:
            for worker in self._workers:
                worker.process.terminate()
            for worker in self._workers:
                worker.process.join(PATIENCE_S)
        finally:
            for worker in self._workers:
                worker.process.kill()

    def _hire(self) -> _Worker:
        context = get_context("spawn")  # a fork would copy the threads and the GPU of this process
        taken = {worker.place for worker in self._workers}
        place = next(place for place in itertools.count() if place not in taken)
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, self.threads, self.explain), daemon=True)
        with _environment(**variables(place, self.threads, self.gpus)), _without_ctrl_c():
            process.start()
        theirs.close()  # so that the end of the worker closes the connection
        self._workers.append(_Worker(process, ours, place))
        return self._workers[-1]


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C for the processes that are started in the block; here it acts after the block."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # otherwise the first start does, which unblocks Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def variables(place: int, threads: int, gpus: Sequence[str]) -> dict[str, str]:
    """Variables of the environment of a worker.

    Args:
        place: Its number among the workers that run at the same time.
        threads: Its threads.
        gpus: As in :class:`Pool`.

    Example:
        >>> [variables(place, 2, ["0", "3"])["CUDA_VISIBLE_DEVICES"] for place in range(3)]
        ['0', '3', '0']
    """
    environment = {"OMP_NUM_THREADS": str(threads), "GOMP_SPINCOUNT": os.environ.get("GOMP_SPINCOUNT", "3000")}
    return environment | ({"CUDA_VISIBLE_DEVICES": gpus[place % len(gpus)]} if gpus else {})


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _receive(worker: _Worker, job: Job) -> Outcome:
    try:
        outcome: Outcome = worker.connection.recv()
        return outcome
    except (EOFError, OSError):
        worker.process.join(PATIENCE_S)
        return lost(job, _how_it_ended(worker.process.exitcode))


def _how_it_ended(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            name = signal.Signals(-code).name
            return (
                f"Its process was ended by {name}, as the system does if memory runs out: use fewer `--workers`, or "
                "--resume if someone else ended it."
                if name == "SIGKILL"
                else f"Its process was ended by {name}: --resume does the run again."
            )
    return f"Its process ended by itself (exit code {code}): see its file in logs, or --resume does the run again."


def _dismiss(worker: _Worker) -> None:
    worker.connection.close()
    worker.process.join(PATIENCE_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

LOCAL = "local"
STOP_S = 300.0  # how long tasks may take to end their runs when the sweep is stopped


def check_ray() -> None:
    """Raise ValueError if Ray is missing."""
    if find_spec("ray") is None:
        raise ValueError("`--ray` needs Ray: install gaussian-swaying[ray], or leave it out.")


class RayBackend:
    """A :class:`Backend` of Ray tasks; Ray places them and shows them.

    All machines must have this package, and see the folder of the sweep and the splats under the same paths.

    Args:
        address: Of a cluster, as for ``ray.init``; ``local`` starts Ray on this machine.
        workers: Jobs at a time; as many as the cluster has room for if None.
        threads: Threads of each job, which Ray counts as CPUs.
        explain: Makes a sentence of an error; a function of a module.
        on_gpu: Whether a job takes a GPU, or a part of one.
        per_gpu: Jobs per GPU; None to learn it from the memory of the first ones.

    Raises:
        ValueError: If Ray is not installed, or there is no cluster at the address.
    """

    def __init__(
        self,
        address: str,
        workers: int | None,
        threads: int,
        explain: Explain = first_line,
        on_gpu: bool = False,
        per_gpu: int | None = 1,
    ) -> None:
        check_ray()
        import ray

        self._ray: Any = ray
        self._ours = not ray.is_initialized()
        if self._ours:
            given: dict[str, Any] = {"num_cpus": workers * threads} if address == LOCAL and workers else {}
            try:
                ray.init(address=None if address == LOCAL else address, log_to_driver=False, **given)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise ValueError(
                    f"There is no Ray cluster at {address} ({first_line(error)}): check `--ray`."
                ) from error
        self.workers, self.threads, self.explain, self.on_gpu = workers, threads, explain, on_gpu
        self.per_gpu, self._learns = per_gpu or 1, per_gpu is None
        self._share = 0.0
        self._running: dict[Any, Job] = {}

    def free(self) -> bool:
        """See ``Backend.free``; a cluster may grow and shrink."""
        resources = self._ray.cluster_resources()
        room = int(resources.get("CPU", 1) // self.threads)
        if self.on_gpu:
            room = int(resources.get("GPU", 1) * self.per_gpu)
        return len(self._running) < max(1, min(room, self.workers or room))

    def submit(self, job: Job) -> None:
        """See ``Backend.submit``."""
        options: dict[str, Any] = {"num_cpus": self.threads, "max_retries": 0, "name": f"run {job.names[0]}"}
        if self.on_gpu:  # Ray then gives every task a process of its own, as a process keeps its GPU
            options |= {"num_gpus": 1 / self.per_gpu, "num_cpus": min(self.threads, 1)}
        task = self._ray.remote(_task).options(**options)
        self._running[task.remote(job, self.threads, self.explain, os.getcwd(), sys.path)] = job

    def wait(self, seconds: float) -> list[tuple[Job, Outcome]]:
        """See ``Backend.wait``."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        return [(job := self._running.pop(reference), self._outcome(reference, job)) for reference in ready]

    def _outcome(self, reference: Any, job: Job) -> Outcome:
        errors = self._ray.exceptions
        try:
            outcome: Outcome = self._ray.get(reference)
            return outcome
        except errors.OutOfMemoryError:
            return lost(
                job, "Its process was ended by Ray as memory ran out: use fewer `--workers`, or a smaller scene."
            )
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.LocalRayletDiedError):
            return lost(job, "Its process or its machine was ended: --resume does the run again.")
        except (errors.TaskCancelledError, errors.RayError) as error:
            return lost(job, f"Ray could not do it ({first_line(error)[:200]}): see Ray's logs.")

    def pack(self, share: float) -> None:
        """See ``Backend.pack``."""
        if self._learns and share > self._share:
            self._share, self.per_gpu = share, max(1, int(PACKED / share))

    def stop(self) -> None:
        try:
            for reference in self._running:
                self._ray.cancel(reference)
            self._ray.wait(list(self._running), num_returns=max(len(self._running), 1), timeout=STOP_S)
        finally:
            self.close()

    def close(self) -> None:
        """See ``Backend.close``."""
        self._running.clear()
        if self._ours:
            self._ray.shutdown()


@cache
def _parser() -> ArgumentParser:
    return Simulation.parser()


def _task(job: Job, threads: int, explain: Explain, folder: str, path: list[str]) -> Outcome:
    import ray

    os.chdir(folder)
    sys.path[:] = [*sys.path, *(entry for entry in path if entry not in sys.path)]
    os.environ[WHERE] = f"{platform.node()} {ray.get_runtime_context().get_node_id()[:8]}"
    torch.set_num_threads(threads)
    done = do(job, _parser(), explain)
    if not done.ready:  # Ray would give it another job: it ends once the result is on its way
        threading.Timer(1.0, os._exit, (0,)).start()
    return done


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
    for group in groups:
        complete = frozenset(name for name in group if name in earlier and earlier[name]["status"] == "complete")
        if len(complete) < len(group):
            own = tuple(dict(runs[name]) for name in group)
            jobs.append(Job(folder, tuple(group), plan.config, plan.frames, own, device, complete=complete))
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
