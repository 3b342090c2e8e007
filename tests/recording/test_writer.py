"""Jobs in the background: their order, their bound, what a failure leaves, and copies that do not wait for a GPU."""

import os
import signal
import threading

import pytest
import torch
from shared import without_waits

from gaussian_swaying.recording.writer import FrameWriter, HostCopy

LONG = 60  # s; only a test that fails waits so long


def _threads_end():
    for thread in threading.enumerate():
        if thread.name == "frame-writer":
            thread.join(LONG)
            assert not thread.is_alive()


@pytest.fixture
def gate():
    """Jobs that wait for it begin, but do not end before it is set; set at the end whatever happens."""
    gate = threading.Event()
    yield gate
    gate.set()
    _threads_end()


# ---- order


def test_jobs_overtake_each_other_but_for_those_of_one_name_and_those_after_all(gate):
    writer, done, free = FrameWriter(workers=3), [], threading.Event()
    writer.submit("a", lambda: (gate.wait(LONG), done.append("a 0")))
    writer.submit("a", lambda: done.append("a 1"))
    writer.submit("last", lambda: done.append("last 0"), after_all=True)
    writer.submit("b", lambda: done.append("b"))
    writer.submit("last", lambda: done.append("last 1"), after_all=True)
    writer.submit("c", lambda: (done.append("c"), free.set()))
    assert free.wait(LONG)
    assert sorted(done) == ["b", "c"]
    gate.set()
    writer.wait()
    assert [name for name in done if name not in ("b", "c")] == ["a 0", "a 1", "last 0", "last 1"]


def test_jobs_are_done_side_by_side():
    """Each of three waits for the other two, which one thread, or two, could not bring to an end."""
    writer, meeting = FrameWriter(workers=3), threading.Barrier(3, timeout=LONG)
    for k in range(3):
        writer.submit(str(k), meeting.wait)
    writer.wait()
    assert not meeting.broken


# ---- bound


def test_whoever_submits_too_much_waits_and_nothing_is_dropped(gate):
    writer, submitted, done, most = FrameWriter(limit=3, workers=2), [], [], []
    hire, waits = writer._hire, threading.Event()
    writer._hire = lambda: hire() or (len(submitted) == 3 and waits.set())

    def produce():
        for k in range(10):
            writer.submit(str(k), lambda k=k: (gate.wait(LONG), most.append(writer.pending), done.append(k)))
            submitted.append(k)

    producer = threading.Thread(target=produce, daemon=True)
    producer.start()
    assert waits.wait(LONG)
    assert submitted == [0, 1, 2]
    assert writer.pending == 3
    gate.set()
    producer.join(LONG)
    writer.wait()
    assert sorted(done) == list(range(10))
    assert max(most) == 3
    assert writer.pending == 0


@pytest.mark.skipif(os.name == "nt", reason="sends SIGINT to itself")
def test_ctrl_c_is_heard_while_the_queue_is_full(gate):
    writer, done = FrameWriter(limit=2, workers=1), []
    for k in range(2):
        writer.submit(str(k), lambda k=k: (gate.wait(LONG), done.append(k)))

    writer._hire = lambda: os.kill(os.getpid(), signal.SIGINT)  # called by who waits

    # ignored where a script starts the tests in the background
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            writer.submit("2", lambda: done.append(2))
    finally:
        signal.signal(signal.SIGINT, before)
        del writer._hire
    gate.set()
    writer.wait()
    assert done == [0, 1]


def test_threads_end_when_there_is_nothing_to_do():
    writer = FrameWriter()
    for _ in range(3):
        writer.submit("job", lambda: None)
    writer.wait()
    _threads_end()
    done = []
    writer.submit("more", lambda: done.append(1))
    writer.wait()
    assert done == [1]


# ---- failure


def _full():
    raise OSError(28, "No space left on device")


def test_after_a_failure_what_came_before_is_done_and_what_came_after_is_not(gate):
    writer, done, fail = FrameWriter(workers=2), [], threading.Event()
    writer.submit("a", lambda: (gate.wait(LONG), done.append("a 0")))
    writer.submit("a", lambda: done.append("a 1"))
    writer.submit("b", lambda: (fail.wait(LONG), _full()))
    writer.submit("checkpoint", lambda: done.append("checkpoint"), after_all=True)
    fail.set()
    with writer._changed:
        assert writer._changed.wait_for(lambda: writer.pending <= 2, LONG)
    gate.set()
    with pytest.raises(OSError, match=r"^b could not be written: No space left on device$"):
        writer.wait()
    writer.wait()  # told once
    with pytest.raises(OSError, match="b could not be written"):
        writer.submit("c", lambda: done.append("c"))
    assert done == ["a 0", "a 1"]


def test_a_failure_frees_whoever_waits_for_a_full_queue(gate):
    writer, done = FrameWriter(limit=1), []
    writer.submit("b", lambda: (gate.wait(LONG), _full()))
    hire = writer._hire
    writer._hire = lambda: hire() or gate.set()  # called by who waits
    with pytest.raises(OSError, match="b could not be written"):
        writer.submit("c", lambda: done.append("c"))
    writer.wait()
    assert done == []


def test_a_mistake_is_raised_as_it_is():
    writer = FrameWriter()
    writer.submit("b", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        writer.wait()


# ---- copies


def test_a_copy_is_what_was_there():
    """Whatever is changed afterwards, in place; with the strides, on which the last bits of a product depend."""
    log, turned = [{"work": 1.0}], torch.arange(6.0).reshape(2, 3).T
    value = {"state": {"F": turned, "grid": (1.0, (2, 3))}, "log": log, "none": None}
    copy = HostCopy(value)
    turned.zero_()
    log[0]["work"] = 2.0
    log.append({})
    value["state"]["grid"] = None
    got = copy.get()
    assert torch.equal(got["state"]["F"], torch.arange(6.0).reshape(2, 3).T)
    assert got["state"]["F"].stride() == (1, 3)
    assert (got["state"]["grid"], got["log"], got["none"]) == ((1.0, (2, 3)), [{"work": 1.0}], None)


@pytest.mark.gpu
def test_a_copy_from_a_gpu_makes_nobody_wait():
    value = {"F": torch.rand(1_000_000, 9, device="cuda"), "half": torch.rand(100, device="cuda").half()}
    expected = {name: tensor.cpu() for name, tensor in value.items()}
    with without_waits():
        copy = HostCopy(value)
        for tensor in value.values():
            tensor.zero_()
        again = torch.full((1_000_000, 9), -1.0, device="cuda")  # would take the memory of a copy that was let go
    got = copy.get()
    assert float(again.sum()) == -9_000_000
    for name, tensor in got.items():
        assert tensor.device.type == "cpu"
        assert tensor.is_pinned()
        assert torch.equal(tensor, expected[name])
