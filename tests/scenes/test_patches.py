import math

import pytest
import torch
from shared import double, near, normalized, peak
from torch.testing import assert_close

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.scenes.patches import box, copies, disc, ellipsoid, facing, join, revolution, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, pot, tints

EXACT = 1e-12


def test_a_tube_has_the_area_and_the_normals_of_a_cylinder():
    """The patches of a ring share its circumference, so the area is exact whatever the spacing."""
    for spacing in (0.5, 0.05):
        patches = tube([[0, 0, 0], [0, 0, 2.0]], [0.3, 0.3], spacing)
        assert float(patches.area.sum()) == pytest.approx(2 * math.pi * 0.3 * 2.0, rel=EXACT)
        radial = normalized(patches.center * double([1.0, 1.0, 0.0]))
        assert_close(patches.normal, radial)


def test_a_bent_tube_keeps_the_area_of_a_torus_piece():
    """Pappus: length of the centre line times circumference. The chords of n rings lack (pi / 2 n)^2 / 6 at most."""
    angle = torch.linspace(0, math.pi / 2, 200, dtype=torch.float64)
    path = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    patches = tube(path, torch.full((200,), 0.1), 0.05)
    assert float(patches.area.sum()) == pytest.approx(math.pi / 2 * 2 * math.pi * 0.1, rel=0.01)
    ring = normalized(patches.center * double([1.0, 1.0, 0.0]))
    outside = ((patches.center - ring) * patches.normal).sum(-1)
    assert outside.min() > 0


def test_an_ellipsoid_faces_outwards_and_a_sphere_has_its_area():
    sphere = ellipsoid((1.0, 2.0, 3.0), (0.5, 0.5, 0.5), 0.05)
    # frustums of height h = 0.05 in a sphere of radius 0.5 lack (h / r)^2 / 8 = 1.3e-3
    assert float(sphere.area.sum()) == pytest.approx(4 * math.pi * 0.25, rel=2e-3)
    offset = sphere.center - double([1.0, 2.0, 3.0])
    assert (normalized(offset) * sphere.normal).sum(-1).min() > 0.99
    long = ellipsoid((0.0, 0.0, 0.0), (0.5, 0.2, 0.1), 0.05)
    gradient = long.center / double([0.25, 0.04, 0.01])
    assert (normalized(gradient) * long.normal).sum(-1).min() > 0.95


def test_a_box_is_closed():
    """Six faces: their area, and by the divergence theorem the volume, which a face turned inwards would spoil."""
    patches = box((0.1, 0.2, 0.3), (0.5, 0.8, 1.3), 0.07)
    assert float(patches.area.sum()) == pytest.approx(2 * (0.4 * 0.6 + 0.4 * 1.0 + 0.6 * 1.0), rel=EXACT)
    volume = (patches.center * patches.normal).sum(-1) @ patches.area / 3
    assert float(volume) == pytest.approx(0.4 * 0.6 * 1.0, rel=EXACT)


def test_a_disc_faces_up():
    patches = disc((1.0, 0.0, 2.0), 0.3, 0.02)
    assert float(patches.area.sum()) == pytest.approx(math.pi * 0.09, rel=1e-9)
    assert_close(patches.normal, double([0.0, 0.0, 1.0]).expand(len(patches), 3))
    assert peak(patches.center[:, 2] - 2.0) == 0


@pytest.mark.parametrize("spacing", [0.2, 0.02, 0.004])
def test_a_flat_leaf_has_the_area_of_its_outline(spacing, leaf_area):
    """Rows are as wide as the blade on average, so the area is the outline's even with a single Gaussian."""
    patches = leaf(0.1, 0.05, spacing, droop=0.0, fold=0.0)
    assert float(patches.area.sum()) == pytest.approx(leaf_area(0.1, 0.05), rel=1e-3)
    assert_close(patches.normal, double([0.0, 0.0, 1.0]).expand(len(patches), 3))
    assert len(patches) == 1 or spacing < 0.1


def test_a_pot_holds_its_earth():
    patches = pot(0.3, 0.1, 0.2, 0.02)
    earth = patches.colour[:, 0] < 0.3
    assert_close(patches.center[earth, 2].double(), double([0.276] * int(earth.sum())))
    assert patches.center[:, 2].min() > 0
    assert patches.center[:, 2].max() <= 0.3


def test_a_linear_map_keeps_edges_and_normals_true():
    """Stretched by a matrix M, areas of a plane grow by |cof(M) n| and normals follow M^-T n."""
    patches = disc((0.0, 0.0, 0.0), 1.0, 0.3)
    matrix = double([[1.0, 0.4, 0.0], [0.0, 2.0, 0.3], [0.5, 0.0, 1.0]])
    mapped = patches.mapped(matrix, (1.0, 0.0, 0.0))
    cofactor = torch.linalg.det(matrix) * torch.linalg.inv(matrix).mT @ double([0.0, 0.0, 1.0])
    assert_close(mapped.area, patches.area * cofactor.norm())
    assert_close(mapped.normal, (cofactor / cofactor.norm()).expand(len(patches), 3))


def test_copies_turn_and_tint_the_template():
    template = disc((0.0, 0.0, 0.0), 0.1, 0.05, (0.5, 0.5, 0.5))
    up = double([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    axes = facing(double([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), up)
    assert_close(torch.linalg.det(axes), torch.ones(2).double())
    tint = double([[1.0, 1.0, 1.0], [0.5, 1.0, 2.0]])
    both = copies(template, axes, double([1.0, 2.0]), torch.zeros(2, 3).double(), tint)
    first, second = both.area.reshape(2, -1)
    assert_close(second, 4 * first)
    normals = both.normal.reshape(2, -1, 3)
    assert_close(normals, up[:, None].expand_as(normals))
    assert_close(both.colour[-1], double([0.25, 0.5, 1.0]))


def test_the_cloud_has_the_patches_normals_sizes_and_light():
    """A patch becomes a Gaussian with standard deviations of half its edges, flat along its normal, lit outside."""
    patches = box((0, 0, 0), (0.4, 0.2, 0.1), 0.1, (0.6, 0.6, 0.6))
    cloud = to_cloud(patches, overlap=0.5, ambient=0.3, two_sided=False)
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
    near(model.normals().double(), patches.normal, 1e-6)
    scales = cloud.scales.exp().sort(-1).values
    near(scales[:, 1:], torch.full((len(patches), 2), 0.05), 1e-6)
    near(scales[:, 0], torch.full((len(patches),), 0.005), 1e-6)
    colours = model.colors(torch.tensor([0.0, 0.0, 1.0]))
    bottom, top = (patches.normal[:, 2] < -0.5), (patches.normal[:, 2] > 0.5)
    near(colours[bottom], torch.full((int(bottom.sum()), 3), 0.18), 1e-6)
    assert colours[top].min() > 0.3
    assert len(join([patches, patches])) == 2 * len(patches)


def test_random_numbers_follow_the_seed():
    assert torch.equal(Draw().normal(5), Draw().normal(5))
    assert tints(Draw(), 7).shape == (7, 3)


def test_a_curve_of_bezier_meets_its_ends():
    points = [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0], [3.0, 0.0, 1.0]]
    curve = bezier(points, 11)
    assert_close(curve[[0, -1]], double(points)[[0, -1]])
    assert_close(curve[5], double([1.25, 1.0, 0.25]))


def test_revolution_of_a_slanted_line_is_a_cone():
    patches = revolution([[0.3, 0.0], [0.0, 0.4]], 0.05)
    assert float(patches.area.sum()) == pytest.approx(math.pi * 0.3 * 0.5, rel=1e-9)
    assert peak(patches.normal[:, 2] - 0.6) < 1e-9
