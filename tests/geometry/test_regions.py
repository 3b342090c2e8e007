import copy

import pytest
import torch
from shared import double, value_error, without_waits

from gaussian_swaying import Box, Cylinder, Sphere
from gaussian_swaying._fixed import changed
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.geometry.regions import Capsule, Everything, HalfSpace, Not, Region, StillGaussians, Union


def _inside(region, *points):
    return region.contains(double(points)).tolist()


def test_box():
    box = Box([0, 0, 0], [1, 2, 3])
    found = _inside(box, (0.5, 1.5, 2.5), (1.5, 1, 1), (0.5, 2.5, 1), (0.5, 1, -0.1), (1, 2, 3))
    assert found == [True, False, False, False, True]
    found = _inside(Box([None, None, 1.5], [None, 2, None]), (1e9, -1e9, 2), (0, 0, 1), (0, 3, 2))
    assert found == [True, False, False]


def test_sphere():
    assert _inside(Sphere([1, 0, 0], 0.5), (1.4, 0, 0), (1, 0.6, 0), (0, 0, 0)) == [True, False, False]


def test_cylinder_is_centred_and_takes_any_axis():
    cylinder = Cylinder([1, 0, 0], [0, 0, 5], radius=0.5, height=2)
    assert _inside(cylinder, (1.4, 0, 0.9), (1.4, 0, -0.9), (1, 0, 1.1), (1.6, 0, 0)) == [True, True, False, False]
    slanted = Cylinder([0, 0, 0], [1, 1, 0], radius=0.1, height=4)
    assert _inside(slanted, (1, 1, 0), (1, 1.2, 0), (2, 2, 0)) == [True, False, False]


def test_the_shapes_of_obstacles_are_regions_as_well():
    """Their surfaces included: a rod with round ends, and all that is behind a plane."""
    rod = Capsule([0, 0, 0], [2, 0, 0], 0.5)
    assert _inside(rod, (1, 0.49, 0), (2.4, 0, 0), (2.4, 0.4, 0), (1, 0.51, 0)) == [True, True, False, False]
    assert _inside(HalfSpace([0, 0, 1], [0, 0, 2]), (9, 9, 1), (0, 0, -9), (0, 0, 1.01)) == [True, True, False]
    with value_error("not a region"):
        _inside(StillGaussians(), (0, 0, 0))


def test_combinations():
    region = Union([Sphere([0, 0, 0], 1), Not(Box([-5, -5, -5], [5, 5, 5]))])
    assert _inside(region, (0, 0, 0), (2, 0, 0), (6, 0, 0)) == [True, False, True]
    assert _inside(Everything(), (0, 0, 0), (1e9, 0, 0)) == [True, True]


REGIONS = [
    Everything(), Box([0, None, 0], [1, 1, None]), Sphere([0, 0, 0], 1), Cylinder([0, 0, 0], [0, 1, 0], 1, 1)
]  # fmt: skip


@pytest.mark.parametrize("region", REGIONS)
def test_batches_and_devices(region, device, dtype):
    for wrapped in (region, Not(region), Union([region, region])):
        inside = wrapped.contains(torch.rand(4, 5, 3, device=device, dtype=dtype))
        assert inside.shape == (4, 5)
        assert inside.dtype == torch.bool
        assert inside.device.type == device.type
        assert isinstance(wrapped, Region)
        with value_error("Expected `points` of shape"):
            wrapped.contains(torch.rand(4, 2))


def test_a_copied_region_is_asked_anew():
    box, point = Box([0, 0, 0], [1, 1, 1]), torch.tensor([[1.5, 0.5, 0.5]])
    assert box.contains(point).tolist() == [False]
    box = changed(box, max=(2.0, 1.0, 1.0))
    assert box.contains(point).tolist() == [True]
    assert copy.deepcopy(box).contains(point.double()).tolist() == [True]


def test_constants_of_an_inference_serve_gradients():
    sphere = Sphere([0, 0, 0], 1)
    with torch.inference_mode():
        sphere.contains(torch.zeros(1, 3))
    points = torch.rand(4, 3, requires_grad=True)
    sphere.contains(points)  # subtracts the centre
    (points - sphere.on(points, sphere.center)).square().sum().backward()
    assert torch.equal(points.grad, 2 * points.detach())


@pytest.mark.gpu
@pytest.mark.parametrize("region", REGIONS)
def test_asking_a_second_time_copies_nothing(region):
    points = torch.rand(40, 3, device="cuda")
    wrapped = Not(Union([region, Sphere([1, 1, 1], 0.1)]))
    known = wrapped.contains(points)
    with without_waits():
        again = wrapped.contains(points)
    assert torch.equal(again, known)


ZERO, UNIT = [0, 0, 0], [0, 0, 1]
REFUSED = [
    (Box, (ZERO, [1, 0, 1]), ValueError, "`min` to be below `max` of the box along y"),
    (Box, ([0, 0, 2], [1, 1, 1]), ValueError, "along z"),
    (Box, ([0, 0], [1, 1, 1]), ValueError, "`min`"),
    (Box, (ZERO, [1, 1, float("nan")]), ValueError, "`max`"),
    (Box, (0, [1, 1, 1]), TypeError, "`min`"),
    (Sphere, (ZERO, 0), ValueError, "`radius`"),
    (Sphere, ([0, 0], 1), ValueError, "`center`"),
    (Cylinder, (ZERO, ZERO, 1, 1), ValueError, "`axis`"),
    (Cylinder, (ZERO, UNIT, -1, 1), ValueError, "`radius`"),
    (Cylinder, (ZERO, UNIT, 1, 0), ValueError, "`height`"),
    (Capsule, (ZERO, UNIT, -1.0), ValueError, "`radius`"),
    (HalfSpace, (ZERO, ZERO), ValueError, "`normal`"),
    (HalfSpace, ([0, 0], UNIT), ValueError, "`point`"),
    (Union, ([],), ValueError, "`regions`"),
    (Union, ([3],), TypeError, "`regions` of Union to be a list of Regions, but got"),
    (Union, (Everything(),), TypeError, "`regions` of Union to be a list"),
    (Not, (Everything,), TypeError, "`region`"),
]


def test_bad_arguments_are_named():
    for kind, given, error, field in REFUSED:
        with pytest.raises(error, match=field):
            kind(*given)


def test_regions_come_from_yaml(tmp_path):
    """The dialect of the configuration files: class_path, init_args and null."""
    from jsonargparse import ArgumentParser

    (tmp_path / "scene.yaml").write_text("""
region:
  class_path: gaussian_swaying.geometry.regions.Union
  init_args:
    regions:
    - class_path: gaussian_swaying.geometry.regions.Box
      init_args: {min: [null, null, 1.5], max: [1, 2, null]}
    - class_path: gaussian_swaying.geometry.regions.Not
      init_args:
        region:
          class_path: gaussian_swaying.geometry.regions.Cylinder
          init_args: {center: [0, 0, 0], axis: [0, 1, 0], radius: 1, height: 2}
    - class_path: gaussian_swaying.geometry.regions.Sphere
      init_args: {center: [0, 0, 0.5], radius: 0.1}
    - class_path: gaussian_swaying.geometry.regions.Everything
""")
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--config", action="config")
    parser.add_argument("--region", type=Region)
    config = parser.parse_args([f"--config={tmp_path / 'scene.yaml'}"])
    instantiate = getattr(parser, "instantiate", None) or parser.instantiate_classes
    regions = instantiate(config).region.regions
    assert [type(region) for region in regions] == [Box, Not, Sphere, Everything]
    assert repr(regions[0]) == "Box(min=[None, None, 1.5], max=[1, 2, None])"


def test_selection_needs_both_region_and_opacity(device, dtype):
    means = torch.tensor([[0.0, 0, 0], [0, 0, 0], [9, 0, 0]], device=device, dtype=dtype)
    opacities = torch.tensor([0.5, 0.01, 0.5], device=device, dtype=dtype)
    assert select_simulated(means, opacities, Sphere([0, 0, 0], 1), 0.02).tolist() == [True, False, False]
    assert select_simulated(means, opacities, None, 0.02).tolist() == [True, False, True]
    assert select_simulated(means, opacities, Everything(), 0).all()


def test_empty_selection_says_what_to_change():
    means = torch.tensor([[0.0, 1, 2], [3, 4, 5]])
    with value_error("No Gaussian is selected") as error:
        select_simulated(means, torch.tensor([0.5, 0.6]), Sphere([9, 9, 9], 1), 0.1)
    for part in ("[0.0, 1.0, 2.0] and [3.0, 4.0, 5.0]", "0 are in Sphere(center=[9, 9, 9], radius=1)", "move"):
        assert part in str(error.value)
    with value_error("at least one Gaussian"):
        select_simulated(means[:0], torch.ones(0), None, 0.1)
    with value_error(r"2 are in Everything.*threshold 0\.9; .*lower the threshold .*opacity is 0\.6"):
        select_simulated(means, torch.tensor([0.5, 0.6]), Everything(), 0.9)
