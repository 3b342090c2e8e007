"""A sweep in parts, as in a SLURM array, and what decides how many jobs share a GPU."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import pytest

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.sweeps.run import Job, Outcome, Pool, drive


@pytest.mark.slow
def test_two_parts_at_the_same_time(undisturbed, tmp_path, sweep_file):
    """Both begin at once in a new folder; the one that ends last writes the table."""
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    options = [str(file), "--output", str(folder), "--workers", "1", "--threads", "1", "--device", "cpu", "--part"]
    quick = "forkserver" in multiprocessing.get_all_start_methods()  # from a process that has imported everything
    context = multiprocessing.get_context("forkserver" if quick else "spawn")
    with ProcessPoolExecutor(2, mp_context=context) as processes:  # each takes one
        assert list(processes.map(main, [[*options, "1/2"], [*options, "2/2"]])) == [0, 0]
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()
    assert (folder / "contact_sheet.png").exists()
    done = {path: path.stat().st_mtime_ns for path in (folder / "results").glob("*.json")}
    assert len(done) == 8
    # submitted again, with nothing left to do
    assert main([str(file), "--output", str(folder), "--device", "cpu", "--part", "2/2"]) == 0
    assert {path: path.stat().st_mtime_ns for path in done} == done


def test_a_part_continues_and_the_last_one_finishes(undisturbed, tmp_path, sweep_file, capsys):
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    options = [str(file), "--output", str(folder), "--workers", "2", "--device", "cpu", "--part"]
    assert main([*options, "3/3"]) == 0
    assert "2 runs: 2 complete" in capsys.readouterr().out
    assert not (folder / "sweep.csv").exists()
    (folder / "results/00002.json").unlink()  # as if it had been killed
    assert main([*options, "3/3"]) == 0
    assert main([str(file), "--output", str(folder), "--workers", "2", "--device", "cpu", "--resume"]) == 0  # the rest
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()
    other = sweep_file(tmp_path / "other.yaml", seed=1)
    assert main([str(other), "--output", str(folder), "--part", "1/3"]) == 2
    assert "other settings" in capsys.readouterr().err


def test_memory_decides_how_many_jobs_share_a_gpu():
    pool = Pool(2, 1, gpus=["0", "1"], most=12)
    pool.pack(0.2)
    assert pool.workers == 8  # 0.9 / 0.2 on each
    pool.pack(0.1)  # a smaller one does not change it
    assert pool.workers == 8
    pool.pack(0.5)
    assert pool.workers == 2
    pool.pack(0.95)
    assert pool.workers == 2
    few = Pool(2, 1, gpus=["0", "1"], most=3)
    few.pack(0.01)
    assert few.workers == 3
    given = Pool(5, 1, gpus=["0"])
    given.pack(0.5)
    assert given.workers == 5


class _Scripted:
    """A backend that ends jobs as it is told."""

    def __init__(self, ends):
        self.ends, self.given, self.shares, self.closed = list(ends), [], [], False
        self._now = None

    def free(self):
        return self._now is None

    def submit(self, job):
        self._now = job
        self.given.append(job)

    def wait(self, seconds):
        if self._now is None:
            return []
        job, self._now = self._now, None
        status, killed, share = self.ends.pop(0)
        return [(job, Outcome({name: {"status": status} for name in job.wanted}, killed, share))]

    def pack(self, share):
        self.shares.append(share)

    def stop(self):
        raise AssertionError("never called")

    def close(self):
        self.closed = True


def _drive(job, ends, retries=1):
    backend, found = _Scripted(ends), {}
    drive([job], backend, lambda name, result: found.update({name: result["status"]}), retries)
    assert backend.closed
    assert backend.ends == []
    return backend, found


def test_what_is_tried_again(tmp_path):
    one = Job(tmp_path, ("00000",), "", 2, ({},))
    bad, killed, good = ("failed", False, None), ("failed", True, None), ("complete", False, 0.3)
    backend, found = _drive(one, [bad, good])
    assert found == {"00000": "complete"}
    assert [job.attempt for job in backend.given] == [1, 2]
    assert backend.shares == [0.3]
    assert _drive(one, [bad, bad])[1] == {"00000": "failed"}
    assert _drive(one, [killed] * 3 + [good])[1] == {"00000": "complete"}
    assert _drive(one, [killed] * 4)[1] == {"00000": "failed"}
    many = Job(tmp_path, ("00000", "00001", "00002"), "", 2, ({}, {}, {}), complete=frozenset({"00001"}))
    backend, found = _drive(many, [bad, good, bad, good])
    assert found == {"00000": "complete", "00002": "complete"}
    assert [job.names for job in backend.given] == [many.names, ("00000",), ("00002",), ("00002",)]
    backend, found = _drive(many, [killed, good])
    assert [job.names for job in backend.given] == [many.names] * 2
    assert found == {"00000": "complete", "00002": "complete"}
