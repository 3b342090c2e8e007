import math

import pytest
import torch
from shared import double, near, peak, rand, randn, value_error
from torch.nn.functional import normalize

from gaussian_swaying.rendering.shading import DiffuseShader, diffuse_shading

COLOR = (0.2, 0.4, 0.8)


def _case(dtype, device="cpu"):
    color = torch.tensor(COLOR, dtype=dtype, device=device)
    light = torch.tensor([0.0, 0.0, 1.0], dtype=dtype, device=device)
    angle = math.radians(30.0)
    normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=dtype, device=device)
    return color, normal, light


def _random_normals(count=50):
    return normalize(randn(count, 3), dim=-1)


def test_diffuse_is_the_cosine(device, dtype):
    color, normal, light = _case(dtype, device)
    shaded = diffuse_shading(color, normal, light)
    assert shaded.dtype == dtype
    torch.testing.assert_close(shaded, color * math.cos(math.radians(30.0)))


def test_diffuse_is_black_when_it_faces_away_unless_two_sided():
    color, normal, light = _case(torch.float64)
    assert diffuse_shading(color, -normal, light).eq(0).all()
    torch.testing.assert_close(
        diffuse_shading(color, -normal, light, two_sided=True), diffuse_shading(color, normal, light)
    )


def test_ambient_blends_linearly():
    color, normal, light = _case(torch.float64)
    cosine = math.cos(math.radians(30.0))
    torch.testing.assert_close(diffuse_shading(color, normal, light, ambient=0.25), color * (0.25 + 0.75 * cosine))
    torch.testing.assert_close(diffuse_shading(color, -normal, light, ambient=0.25), color * 0.25)
    torch.testing.assert_close(diffuse_shading(color, -normal, light, ambient=1.0), color)


def test_light_is_normalised_and_negative_colours_are_clamped():
    color, normal, _ = _case(torch.float32)
    torch.testing.assert_close(DiffuseShader((0, 0, 7.0))(color, normal), DiffuseShader()(color, normal))
    assert DiffuseShader()(-color, normal).eq(0).all()


def test_relative_diffuse_is_the_ratio_of_the_factors():
    color, normal, light = _case(torch.float64)
    rest = double([math.sin(1.0), 0.0, math.cos(1.0)])
    expected = color * math.cos(math.radians(30.0)) / math.cos(1.0)
    torch.testing.assert_close(diffuse_shading(color, normal, light, rest_normal=rest), expected)
    grazing = double([1.0, 0.0, 0.0])  # factor 0, raised to 0.1
    torch.testing.assert_close(diffuse_shading(color, light, light, rest_normal=grazing), 10.0 * color)


@pytest.mark.parametrize("two_sided", [False, True])
def test_relative_leaves_the_rest_picture_unchanged(two_sided):
    normal, color = _random_normals(), rand(50, 3)
    shader = DiffuseShader((1.0, -2.0, 0.5), two_sided=two_sided, relative=True)
    near(shader(color, normal, normal), color, 1e-15)
    assert peak(shader(color, _random_normals(), normal) - color) > 0.1


def test_two_sided_does_not_see_the_sign_of_the_normal():
    normal, color, shader = _random_normals(), rand(50, 3), DiffuseShader((0, 1, 1), True, ambient=0.2)
    torch.testing.assert_close(shader(color, normal), shader(color, -normal))


def test_gradients():
    color, normal, rest = rand(5, 3), _random_normals(5), _random_normals(5)
    color.requires_grad_()
    normal.requires_grad_()
    shader = DiffuseShader((1, 1, 1), True, ambient=0.3, relative=True)
    assert torch.autograd.gradcheck(lambda c, n: shader(c, n, rest), (color, normal))


def test_bad_arguments():
    with value_error("`light`"):
        DiffuseShader(light=(0.0, 0.0, 0.0))
    with value_error("`light`"):
        DiffuseShader(light=(0.0, 1.0))
    with value_error("`rest_normal`"):
        DiffuseShader(relative=True)(torch.ones(3), torch.ones(3))
    with value_error("`normal`"):
        DiffuseShader()(torch.ones(3), torch.ones(2))
