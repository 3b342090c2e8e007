"""Ray as the backend of a sweep: processes of this machine, or of a cluster by its address."""

from __future__ import annotations

import os
import platform
import sys
import threading
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch

from gaussian_swaying._checks import first_line
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.backend import PACKED, Job, Outcome, lost
from gaussian_swaying.sweeps.worker import WHERE, Explain, do

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

LOCAL = "local"
STOP_S = 300.0  # how long tasks may take to end their runs when the sweep is stopped


def check_ray() -> None:
    """Raise ValueError if Ray is missing."""
    if find_spec("ray") is None:
        raise ValueError("`--ray` needs Ray: install gaussian-swaying[ray], or leave it out.")


class RayBackend:
    """A :class:`~gaussian_swaying.sweeps.backend.Backend` of Ray tasks; Ray places them and shows them.

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
