"""What a CUDA graph may record, and when a recorded one no longer holds."""

from torch import nn

from gaussian_swaying._graphs import fingerprint
from gaussian_swaying.aero.wind import GaussianGust, Modulation, SineSway, UniformGust, WindField
from gaussian_swaying.gaussians.selection import Box
from gaussian_swaying.mpm import boundary
from gaussian_swaying.mpm.boundary import Boundary, PinnedRegion, Plane, VelocityBox


def test_what_is_here_can_be_recorded():
    found = [kind for kind in vars(boundary).values() if isinstance(kind, type) and issubclass(kind, Boundary)]
    concrete = [kind for kind in (*found, SineSway, UniformGust, GaussianGust) if not kind.__abstractmethods__]
    assert len(concrete) == 10
    assert all(kind.recordable for kind in concrete)


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
