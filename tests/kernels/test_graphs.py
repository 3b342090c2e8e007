"""What a CUDA graph may record, and when a recorded one no longer holds."""

import weakref
from contextlib import contextmanager

import pytest
import torch
from torch import nn

from gaussian_swaying import Boundary, Box, GaussianGust, PinnedRegion, SineSway, UniformGust, WindField
from gaussian_swaying._fixed import assign
from gaussian_swaying.geometry.regions import Everything, Not, Union
from gaussian_swaying.kernels.graphs import Repeater, Replayed, fingerprint, tensors_in
from gaussian_swaying.mpm.boundaries import BOUNDARIES
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.wind.field import Modulation


def test_what_is_here_can_be_recorded():
    concrete = [*BOUNDARIES.values(), SineSway, UniformGust, GaussianGust]
    assert len(concrete) == 18
    assert all(kind.recordable for kind in concrete if kind is not VelocityBox)  # which asks its region


def test_a_forward_of_its_own_has_to_say_so():
    class Slower(UniformGust):
        def forward(self, velocity, time, seed, stream):
            return velocity * float(time.amax())

    class Sure(Slower):
        recordable = True

        def forward(self, velocity, time, seed, stream):
            return 2 * velocity

    class Named(PinnedRegion):
        name = "pole"

    assert not any(kind.recordable for kind in (Modulation, Boundary, Slower))
    assert Sure.recordable
    assert Named.recordable


def test_fingerprint_sees_what_was_replaced():
    region = Box([0.0] * 3, [1.0] * 3)
    wind = WindField(modulations=[UniformGust(0.3, 0.04)])
    parts = [wind, Plane([0.0] * 3, [0.0, 0.0, 1.0]), VelocityBox(region, [1.0, 0.0, 0.0])]
    seen = [fingerprint(parts)]
    kept = [wind.modulations[0], wind.flows, region]
    for change in (
        lambda: assign(wind, seed=3),
        lambda: assign(wind, modulations=nn.ModuleList([GaussianGust(0.3, 0.04)])),
        lambda: assign(wind, flows=wind.flows.clone()),
        lambda: assign(parts[1], kind="slip"),
        lambda: assign(parts[2], region=Box([0.0] * 3, [1.0] * 3)),
    ):
        assert fingerprint(parts) == seen[-1]
        change()
        seen.append(fingerprint(parts))
    assert len(set(seen)) == len(seen) == 6
    wind.flows.fill_(2.0)
    assert fingerprint(parts) == seen[-1]
    del kept  # until here, so that nothing new lies where they did


def test_tensors_of_modules():
    gust = UniformGust()
    gust.add_module("learned", nn.Linear(2, 3))
    wind = WindField(modulations=[gust])
    expected = [*wind.parameters(), *wind.buffers()]
    assert {id(tensor) for tensor in tensors_in([wind])} == {id(tensor) for tensor in expected}
    assert len(tensors_in([wind, WindField()])) == len(expected) + 2


def test_regions_say_for_themselves_whether_they_can_be_recorded():
    class Own(Box):
        def contains(self, points):
            return points[..., 0] < float(points.mean())

    box, own = Box([0, 0, 0], [1, 1, 1]), Own([0, 0, 0], [1, 1, 1])
    assert box.recordable
    assert Union([box, Not(Everything())]).recordable
    for region in (own, Not(own), Union([box, own])):
        assert not region.recordable
        assert not VelocityBox(region, [0.0, 0.0, 0.0]).recordable
    assert VelocityBox(box, [0.0, 0.0, 0.0]).recordable


def test_work_runs_as_often_as_asked_without_cuda():
    done, repeater = [], Repeater(torch.device("cpu"))
    for times in (0, 1, 23):
        repeater.run(times, "key", done.append)
    assert sum(done) == 24


class _Driver:
    """What PyTorch keeps of graphs and their memory: sizes of free blocks by pool and stream, in place of a GPU.

    A block that was freed on a stream serves that stream again, within its pool; a pool lasts as long as a graph of it,
    and what it held is given back when the cache is emptied.
    """

    def __init__(self, memory):
        self.memory, self.free, self.users, self.alive = memory, {}, {}, weakref.WeakSet()
        self.capturing, self.streams, self.stream = None, 0, _Stream(0)

    @property
    def reserved(self):
        return sum(map(sum, self.free.values()))

    def new_stream(self, device):
        self.streams += 1
        return _Stream(self.streams)

    def new_graph(self):
        graph = _Graph(self)
        self.alive.add(graph)
        return graph

    def allocate(self, size):
        """A tensor that the work needs for a moment."""
        blocks = self.free.setdefault(self.capturing, [])
        if not any(block >= size for block in blocks):
            if self.reserved + size > self.memory:
                raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {size} MiB. GPU 0 is full.")
            blocks.append(size)

    def empty_cache(self):
        assert self.capturing is None
        self.free = {place: blocks for place, blocks in self.free.items() if self.users.get(place and place[0])}


class _Stream:
    def __init__(self, number):
        self.number = number

    def wait_stream(self, other):
        pass


class _Graph:
    def __init__(self, driver):
        self.driver, self.place = driver, None

    def capture_begin(self, pool=None, capture_error_mode="global"):
        assert pool is None or self.driver.users[pool] > 0  # as PyTorch asserts
        self.place = (object() if pool is None else pool, self.driver.stream.number)
        self.driver.users[self.place[0]] = self.driver.users.get(self.place[0], 0) + 1
        self.driver.capturing = self.place

    def capture_end(self):
        self.driver.capturing = None

    def pool(self):
        return self.place[0]

    def replay(self):
        assert self.place is not None

    def reset(self):
        if self.place is not None:
            self.driver.users[self.place[0]] -= 1
            self.place = None

    __del__ = reset


@pytest.fixture
def driver(monkeypatch):
    """Graphs without a GPU."""
    driver = _Driver(memory=2000)

    @contextmanager
    def on(stream):
        before, driver.stream = driver.stream, stream
        try:
            yield
        finally:
            driver.stream = before

    for name, value in (
        ("CUDAGraph", driver.new_graph),
        ("Stream", driver.new_stream),
        ("stream", on),
        ("current_stream", lambda device: driver.stream),
        ("synchronize", lambda device: None),
        ("empty_cache", driver.empty_cache),
    ):
        monkeypatch.setattr(torch.cuda, name, value)
    return driver


def test_graphs_of_many_grids_take_the_memory_of_one(driver):
    """A grid that grows a hundred times: what a recording took serves the next, or is given back."""
    repeater, sizes = Repeater(torch.device("cuda")), [*range(100, 200), *range(200, 100, -1)]
    for size in sizes:
        repeater.forget()

        def several(n, size=size):
            for _ in range(n):
                driver.allocate(size)
                driver.allocate(size // 2)

        for _ in range(3):
            repeater.run(21, size, several)
        assert len(driver.alive) == 3
        assert driver.reserved <= 2 * size
    repeater.forget()
    assert not driver.alive


def test_no_more_than_some_works_are_kept(driver):
    repeater, called = Repeater(torch.device("cuda")), []

    def several(n):
        called.append(n)
        driver.allocate(10)

    for key in range(20):
        for _ in range(2):
            repeater.run(1, key, several)
        assert len(driver.alive) <= repeater.kept
    assert len(driver.alive) == repeater.kept
    assert driver.reserved <= 20  # one block of the works that are recorded, one of those that ran as they are
    del called[:]
    for key in (19, 16):
        repeater.run(1, key, several)
    assert called == []
    repeater.run(1, 0, several)
    repeater.run(1, 16, several)
    repeater.run(1, 17, several)
    assert called == [1, 1]  # 0 was forgotten, and 17, which ran longest ago, is now


def test_a_function_without_cuda_is_called():
    called = []
    replayed = Replayed()
    for k in range(3):
        (found,) = replayed("key", lambda x: called.append(1) or [2 * x], torch.full((2,), float(k)))
        assert found.tolist() == [2 * k] * 2
    assert len(called) == 3
    assert not replayed.recorded


def test_a_work_that_can_no_longer_be_recorded_leaves_no_pool_behind(driver):
    """Its graphs were the only ones of their pool, which nothing else may join then."""
    repeater = Repeater(torch.device("cuda"))
    for recordable in (True, True, False, True, True):
        repeater.run(1, "key", lambda n: driver.allocate(10), recordable)
    assert len(driver.alive) == 1


def test_what_is_missing_is_named(driver):
    """Memory, or a work that does not wait; the graph of the failed attempt is gone, though the error is still here."""
    repeater = Repeater(torch.device("cuda"))
    recording = []

    def fail(error):
        def several(n):
            if driver.capturing is not None:
                recording.append(n)
                raise error

        return several

    def attempt(several, kind, match):
        repeater.run(1, several, several)
        with pytest.raises(kind, match=match) as caught:
            repeater.run(1, several, several)
        assert all(graph.place is None for graph in driver.alive)
        assert driver.capturing is None
        return str(caught.value)

    def large(n):
        driver.allocate(3000 if driver.capturing is not None else 1)

    for several in (large, fail(RuntimeError("Triton Error [CUDA]: out of memory"))):
        said = attempt(several, torch.OutOfMemoryError, r"no memory.*out of memory.*EnclosingBox.*raise `solver\.dx`")
        assert "recordable" not in said
        assert "GPU 0" not in said
    waits = RuntimeError("CUDA error: operation not permitted when stream is capturing")
    attempt(fail(waits), RuntimeError, r"cannot be recorded.*set `recordable` to False on the boundary")
    broken = RuntimeError("CUDA error: an illegal memory access was encountered")
    assert attempt(fail(broken), RuntimeError, "illegal memory access") == str(broken)
    assert recording == [1, 1, 1]


@pytest.mark.gpu
def test_work_is_recorded_from_the_second_time_on_and_after_forgetting():
    device = torch.device("cuda")
    total, called = torch.zeros(1, device=device), []
    repeater = Repeater(device)

    def several(n):
        called.append(n)
        total.add_(n)

    for times in (3, 23, 23):
        repeater.run(times, "key", several)
    assert called == [1, 1, 1, 16, 4, 1]  # as it is three times, then one recording of each size
    repeater.forget()
    for times in (1, 5):
        repeater.run(times, "key", several)
    assert called[6:] == [1, 4, 1]
    repeater.run(1, "other", several, recordable=False)
    repeater.run(1, "other", several, recordable=False)
    assert called[9:] == [1, 1]
    assert float(total) == 3 + 23 + 23 + 1 + 5 + 2


@pytest.mark.gpu
def test_a_function_is_replayed_with_its_inputs_of_now():
    called, replayed = [], Replayed()

    def function(x, y):
        called.append(1)
        return [x + y, x.sum()[None]]

    kept = []
    with torch.no_grad():
        for k in range(5):
            x, y = torch.full((3,), float(k), device="cuda"), torch.ones(3, device="cuda")
            kept.append(replayed("key", function, x, y))
        for k, found in enumerate(kept):
            assert [values.tolist() for values in found] == [[k + 1.0] * 3, [3.0 * k]]
        assert len(called) == 2  # as it is, and recorded
        replayed("key", function, x.double(), y.double())
        replayed("other", function, x, y)
        assert len(called) == 4
    function(x.requires_grad_(), y)
    assert replayed("other", function, x, y)[0].requires_grad
