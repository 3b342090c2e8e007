import math

import pytest
import torch
from shared import near, peak, rand, value_error
from torch.testing import assert_close

from gaussian_swaying.captures.capture import read_capture
from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.rendering.cameras.camera import look_at_camera


@pytest.fixture(scope="module")
def small():
    return GeneratedCapture(views=12, size=64)


def test_slopes_are_the_derivatives_of_the_height(small):
    x, z = (rand(50).requires_grad_() for _ in range(2))
    expected = torch.autograd.grad(small.elevation(x, z).sum(), (x, z))
    for found, gradient in zip(small.slopes(x, z), expected, strict=True):
        assert_close(found.detach(), gradient)
    assert peak(expected[0]) > 0.3  # a flag worth looking at


def test_pictures_show_the_true_surface(small):
    """Colours are those of the place where a march in 1500 small steps first crosses the sheet."""
    single = GeneratedCapture(views=12, size=64, samples=1)
    missed = several = total = 0
    grazing = look_at_camera((2.4, -0.5, 0.5), (0.6, 0, 0.4), (0, 0, 1), 40.0, 64, 64)
    for camera in [*small.cameras()[::3], grazing]:
        view = single.render(camera)
        v, u = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        intrinsics, pose = camera.intrinsics.double(), torch.linalg.inv(camera.world_to_camera.double())
        rays = torch.stack([(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]], -1)
        rays = torch.nn.functional.pad(rays.double(), (0, 1), value=1.0) @ pose[:3, :3].T
        t = torch.linspace(1.2, 3.2, 1501, dtype=torch.float64)[:, None, None]
        x, y, z = (pose[axis, 3] + t * rays[..., axis] for axis in range(3))
        above = y > small.elevation(x, z)
        crossed = (above[1:] != above[:-1]) & (x[1:] > 0) & (x[1:] < 1.2) & (z[1:] > 0) & (z[1:] < 0.8)
        first = crossed.int().argmax(0)[None]
        expected = small.colors(x.gather(0, first)[0], z.gather(0, first)[0])
        hit = view[..., 3] == 1
        agree = (hit == crossed.any(0)) & (~hit | ((view[..., :3] - expected).abs().amax(-1) < 0.05))
        missed, several = missed + int((~agree).sum()), several + int((crossed.sum(0) > 1).sum())
        total += int(hit.sum())
    assert several > 100  # the ripple hides a part of itself in some views
    assert missed < 0.015 * total  # rays that touch the sheet, its edges or those of its pattern within a step


def test_pixels_average_what_is_covered():
    """A flag head on, 1.2 x 0.8 m: the alphas add up to its area in the picture."""
    flat = GeneratedCapture(views=1, size=64, ripple=0.0, samples=4)
    camera = look_at_camera((0.6, -2.2, 0.4), (0.6, 0.0, 0.4), (0.0, 0.0, 1.0), 40.0, 64, 64)
    view = flat.render(camera)
    scale = float(camera.intrinsics[0, 0]) / 2.2
    colors, alpha = view[..., :3], view[..., 3]
    assert float(alpha.sum()) == pytest.approx(0.96 * scale**2, rel=0.01)
    assert (alpha == 1).sum() > 500
    assert peak(colors[alpha == 0]) == 0
    top, bottom = colors[18, 32] / alpha[18, 32], colors[45, 32] / alpha[45, 32]
    assert top[0] > 2 * float(top[2])  # red above
    assert bottom[2] > 2 * float(bottom[0])  # blue below


def test_the_folder_is_a_capture(tmp_path, small):
    folder = small.write(tmp_path / "flag")
    capture = read_capture(folder)
    assert (len(capture.split("train")), len(capture.split("test"))) == (10, 2)
    for view, camera in zip(capture.views, small.cameras(), strict=True):
        near(view.camera.world_to_camera, camera.world_to_camera.float(), 1e-6)
        assert_close(view.camera.intrinsics, camera.intrinsics.float())
    packed = small.render(small.cameras()[5])
    near(capture.views[5].load().float() / 255, packed, 0.009)
    with value_error("not empty"):
        small.write(folder)


def test_the_seed_decides_everything(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        GeneratedCapture(views=2, size=16, seed=seed).write(tmp_path / name, threads=1 if name == "a" else 2)
    for file in ("transforms.json", "images/0001.png"):
        one, two, three = ((tmp_path / name / file).read_bytes() for name in "abc")
        assert one == two != three, file


def test_cameras_are_all_around():
    cameras = GeneratedCapture(views=64).cameras()
    for some in (cameras, cameras[::8]):
        rays = torch.stack([camera.position - torch.tensor([0.6, 0.0, 0.4]) for camera in some])
        assert_close(rays.norm(dim=-1), torch.full((len(some),), 2.2).double())
        quarter = torch.atan2(rays[:, 1], rays[:, 0]) // (0.5 * math.pi)
        assert len(quarter.unique()) == 4
        assert rays[:, 2].max() > 0.6 * 2.2 > 0 > -0.2 * 2.2 > rays[:, 2].min()


@pytest.mark.parametrize(
    ("name", "value"),
    [("views", 0), ("size", 1.5), ("samples", 0), ("width", -1.0), ("ripple", -0.1), ("fov", 180.0), ("distance", 0.5)],
)
def test_bad_arguments(name, value):
    with value_error(f"`{name}`"):
        GeneratedCapture(**{name: value})
