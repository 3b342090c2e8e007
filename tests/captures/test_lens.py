from dataclasses import replace

import pytest
import torch
from shared import double, near, rand, value_error

from gaussian_swaying.captures.lens import Lens, distort, remap, undistort

FOX = (0.0578421, -0.0805099, -0.000980296, 0.00015575, 0.0)
BARREL = (-0.2, 0.03, 0.002, -0.001, 0.001)
PINCUSHION = (0.15, 0.02, -0.002, 0.003, 0.0)


def _lens(distortion, width=90, height=60):
    return Lens(70.0, 74.0, 43.5, 31.25, width, height, distortion)


def test_distortion_of_a_point_by_hand():
    """x = (0.5, -0.2): r2 = 0.29, radial = 1 + 0.1 r2 + 0.2 r2^2 + 0.3 r2^3."""
    seen = distort(double([0.5, -0.2]), (0.1, 0.2, 0.01, 0.02, 0.3))
    radial = 1 + 0.1 * 0.29 + 0.2 * 0.29**2 + 0.3 * 0.29**3
    x = 0.5 * radial + 2 * 0.01 * 0.5 * -0.2 + 0.02 * (0.29 + 2 * 0.25)
    y = -0.2 * radial + 0.01 * (0.29 + 2 * 0.04) + 2 * 0.02 * 0.5 * -0.2
    assert seen.tolist() == pytest.approx([x, y], abs=1e-14)


@pytest.mark.parametrize("distortion", [FOX, BARREL, PINCUSHION])
def test_the_undistorted_picture_is_that_of_a_pinhole(distortion):
    """The scene is a plane at depth 1 whose brightness is linear in place: no interpolation error to hide behind."""
    points = 1.2 * rand(500, 2) - 0.6
    near(undistort(distort(points, distortion), distortion), points, 1e-10)
    lens = _lens(distortion)
    columns, rows = torch.arange(90) + 0.5, torch.arange(60) + 0.5
    v, u = torch.meshgrid((rows - lens.cy) / lens.fy, (columns - lens.cx) / lens.fx, indexing="ij")
    place = undistort(torch.stack([u, v], -1).double(), distortion)
    image = torch.stack([place[..., 0], place[..., 1] - 2 * place[..., 0]])
    target = lens.undistorted()
    assert not target.distorted
    x = (torch.arange(target.width) + 0.5 - target.cx) / target.fx
    y = (torch.arange(target.height) + 0.5 - target.cy) / target.fy
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    expected = torch.stack([gx, gy - 2 * gx]).double()
    near(remap(image, lens, target), expected, 2e-4)
    assert (expected[0, 0, 1] - expected[0, 0, 0]).abs() > 1e-2  # a pixel off would show


@pytest.mark.parametrize("distortion", [FOX, BARREL, PINCUSHION])
def test_the_undistorted_picture_is_the_largest_that_is_covered(distortion):
    lens = _lens(distortion)
    target = lens.undistorted()

    def covered(left, top, right, bottom):
        x = torch.cat([torch.arange(left, right) + 0.5]) - target.cx
        y = torch.cat([torch.arange(top, bottom) + 0.5]) - target.cy
        v, u = torch.meshgrid(y.double() / target.fy, x.double() / target.fx, indexing="ij")
        seen = distort(torch.stack([u, v], -1), distortion) * torch.tensor([lens.fx, lens.fy])
        seen = seen + torch.tensor([lens.cx, lens.cy])
        inside = (seen >= 0.5) & (seen <= torch.tensor([lens.width, lens.height]) - 0.5)
        return bool(inside.all())

    w, h = target.width, target.height
    assert covered(0, 0, w, h)
    assert not any(covered(*box) for box in [(-1, 0, w, h), (0, -1, w, h), (0, 0, w + 1, h), (0, 0, w, h + 1)])


def test_no_distortion_changes_nothing():
    lens = _lens((0.0,) * 5)
    assert lens.undistorted() is lens
    image = rand(3, 60, 90)
    near(remap(image, lens, lens), image, 1e-12)


def test_smaller_lenses_see_the_same_rays():
    lens = replace(_lens((0.0,) * 5), width=91, height=62)
    small = lens.averaged(4)
    assert (small.width, small.height) == (22, 15)
    for pixel in (0.5, 10.5):  # the centre of a pixel is the mean of the centres of its 16
        mean = sum(4 * pixel - 2 + 0.5 + i for i in range(4)) / 4
        assert (pixel - small.cx) / small.fx == pytest.approx((mean - lens.cx) / lens.fx)
        assert (pixel - small.cy) / small.fy == pytest.approx((mean - lens.cy) / lens.fy)
    half = lens.resized(45, 31)
    assert (half.fx, half.cy) == pytest.approx((70.0 * 45 / 91, 31.25 / 2))


def test_bad_lenses():
    with value_error("folds the image"):
        _lens((-2.0, 0.0, 0.0, 0.0, 0.0)).undistorted()
    with value_error("`fx` of a lens"):
        Lens(0.0, 1.0, 0.0, 0.0, 4, 4)
    with value_error("distortion"):
        _lens((0.0, float("nan"), 0.0, 0.0, 0.0))
    with value_error("lower `downscale`"):
        _lens((0.0,) * 5).averaged(61)
