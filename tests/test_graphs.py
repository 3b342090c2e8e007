"""What a CUDA graph may record, and when a recorded one no longer holds."""

import pytest
import torch
from torch import nn

from gaussian_swaying._graphs import Repeater, fingerprint
from gaussian_swaying.aero.wind import GaussianGust, Modulation, SineSway, UniformGust, WindField
from gaussian_swaying.gaussians.selection import Box, Everything, Not, Union
from gaussian_swaying.mpm import boundary
from gaussian_swaying.mpm.boundary import Boundary, PinnedRegion, Plane, VelocityBox


def test_what_is_here_can_be_recorded():
    found = [kind for kind in vars(boundary).values() if isinstance(kind, type) and issubclass(kind, Boundary)]
    concrete = [kind for kind in (*found, SineSway, UniformGust, GaussianGust) if not kind.__abstractmethods__]
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


def test_fingerprint_sees_what_was_replaced():
    region = Box([0.0] * 3, [1.0] * 3)
    wind = WindField(modulations=[UniformGust(0.3, 0.04)])
    parts = [wind, Plane([0.0] * 3, [0.0, 0.0, 1.0]), VelocityBox(region, [1.0, 0.0, 0.0])]
    seen = [fingerprint(parts)]
    kept = [wind.modulations[0], wind.flows, region]
    for change in (
        lambda: setattr(wind, "seed", 3),
        lambda: setattr(wind, "modulations", nn.ModuleList([GaussianGust(0.3, 0.04)])),
        lambda: setattr(wind, "flows", wind.flows.clone()),
        lambda: setattr(parts[1], "kind", "slip"),
        lambda: setattr(parts[2], "region", Box([0.0] * 3, [1.0] * 3)),
    ):
        assert fingerprint(parts) == seen[-1]
        change()
        seen.append(fingerprint(parts))
    assert len(set(seen)) == len(seen) == 6
    wind.flows.fill_(2.0)
    assert fingerprint(parts) == seen[-1]
    del kept  # until here, so that nothing new lies where they did


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
