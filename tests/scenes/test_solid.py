import math

import pytest
import torch
from shared import near, normalized, peak, value_error

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.scenes.solid import SolidScene

SHAPES = ["figure", "ball", "box", "torus"]


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shell_lies_on_the_surface(shape):
    """To the float32 of the positions; Newton's steps on the blended figure leave a little more."""
    scene = SolidScene(shape, spacing=0.05, gaussians="shell")
    cloud = scene.generate()
    assert len(cloud) > 300
    assert peak(scene.distance(cloud.means.double())) < (1e-3 if shape == "figure" else 1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_gaussians_throughout_are_the_shell_and_a_core(shape):
    scene = SolidScene(shape, spacing=0.05)
    solid, shell = scene.generate(), SolidScene(shape, spacing=0.05, gaussians="shell").generate()
    assert torch.equal(solid.means[: len(shell)], shell.means)
    core = scene.distance(solid.means[len(shell) :].double())
    assert len(core) > 0
    assert core.max() < -0.4 * 0.05
    assert torch.equal(solid.scales[0], solid.scales[-1])  # as large as those of the surface


def test_normals_are_true():
    ball = SolidScene("ball", spacing=0.05, gaussians="shell").generate()
    near(ball.normals, normalized(ball.means), 1e-4)
    torus = SolidScene("torus", spacing=0.05, gaussians="shell").generate()
    ring = normalized(torus.means * torch.tensor([1.0, 1.0, 0.0])) * 0.5 / 1.3
    expected = normalized(torus.means - ring)
    near(torus.normals, expected, 1e-4)
    for cloud in (ball, torus, SolidScene(spacing=0.05).generate()):
        along = (smallest_axis_normal(cloud.quats, cloud.scales) * cloud.normals).sum(-1)
        near(along, torch.ones(len(cloud)), 1e-5)


def test_the_shell_covers_the_surface():
    cloud = SolidScene("ball", spacing=0.05, gaussians="shell").generate()
    assert float(GaussianSurfaceModel.from_cloud(cloud).areas().sum()) == pytest.approx(math.pi, rel=0.05)


def test_the_same_arguments_give_the_same_splat():
    first, again = (SolidScene(spacing=0.1).generate() for _ in range(2))
    assert torch.equal(first.means, again.means)
    assert torch.equal(first.sh, again.sh)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"shape": "cone"}, "generator.shape"),
        ({"gaussians": "none"}, "generator.gaussians"),
        ({"size": 0.0}, "generator.size"),
        ({"spacing": 0.3}, "quarter of the size"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    with value_error(words):
        SolidScene(**settings)
