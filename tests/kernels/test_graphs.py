import copy

import pytest
import torch
from catalogue import BOUNDARIES
from torch import nn

from gaussian_swaying import Boundary, Box, GaussianGust, PinnedRegion, SineSway, UniformGust, WindField
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.geometry.regions import Everything, Not, Union
from gaussian_swaying.kernels.graphs import Repeater, Replayed, recorded_key, tensors_in
from gaussian_swaying.mpm.colliders import VelocityBox
from gaussian_swaying.wind.field import Modulation


def test_what_is_here_can_be_recorded():
    concrete = [*BOUNDARIES.values(), SineSway, UniformGust, GaussianGust]
    assert len(concrete) == 10
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


def test_tensors_of_modules():
    gust = UniformGust()
    gust.add_module("learned", nn.Linear(2, 3))
    wind = WindField(modulations=[gust])
    expected = [*wind.parameters(), *wind.buffers()]
    assert {id(tensor) for tensor in tensors_in([wind])} == {id(tensor) for tensor in expected}
    still = WindField()
    assert len(tensors_in([wind, still])) == len(expected) + len([*still.parameters(), *still.buffers()])


def test_what_makes_a_recording_invalid():
    class Own(UniformGust):
        share = 1.0

    gust = Own()
    gust.register_buffer("table", torch.zeros(3))
    before = recorded_key([gust])
    gust.table += 1.0
    gust.share, gust._known = gust.share, 2.0
    gust.eval()
    changed(gust, delta=0.1)
    assign(Own(0.3), delta=0.4)
    assert recorded_key([gust]) == before
    for change in (
        lambda: setattr(gust, "share", 2.0),
        lambda: assign(gust, delta=0.7),
        lambda: setattr(gust, "table", torch.zeros(3)),
        lambda: gust.register_buffer("table", torch.zeros(4)),
        gust.double,
        lambda: delattr(gust, "table"),
    ):
        change()
        after = recorded_key([gust])
        assert after != before
        before = after
    assert recorded_key([copy.copy(gust)]) != before


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
    done, count, repeater = [], torch.zeros(1), Repeater(torch.device("cpu"))
    for times in (0, 1, 23):
        repeater.run(times, "key", done.append, counter=count)
    assert done == [0] * 24
    assert float(count) == 24


def test_a_function_without_cuda_is_called():
    called = []
    replayed = Replayed()
    for k in range(3):
        (found,) = replayed("key", lambda x: called.append(1) or [2 * x], torch.full((2,), float(k)))
        assert found.tolist() == [2 * k] * 2
    assert len(called) == 3


@pytest.mark.gpu
def test_work_is_recorded_from_the_second_time_on_and_after_forgetting():
    device = torch.device("cuda")
    total, called = torch.zeros(1, device=device), []
    repeater = Repeater(device)

    count = torch.zeros_like(total)

    def work(offset):
        called.append(offset)
        total.add_(1 + offset)

    def called_for(sizes):
        return [offset for size in sizes for offset in range(size)]

    for times in (3, 23, 23):
        repeater.run(times, "key", work, counter=count)
    assert called == called_for([1, 1, 1, 16, 4, 1])  # as it is three times, then one recording of each size
    repeater.forget()
    called.clear()
    for times in (1, 5):
        repeater.run(times, "key", work, counter=count)
    assert called == called_for([1, 4, 1])
    for _ in range(2):
        repeater.run(1, "other", work, recordable=False)
    assert called[6:] == [0, 0]
    assert float(count) == 3 + 23 + 23 + 1 + 5
    assert float(total) == 3 + 2 * (136 + 10 + 3) + 1 + (10 + 1) + 2


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
