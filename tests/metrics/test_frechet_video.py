"""Fréchet distance on Gaussians with a known one, and on videos with a network whose features are known."""

import hashlib
import math

import pytest
import torch
from shared import double, randn, value_error
from torch import Tensor, nn
from torch.testing import assert_close

from gaussian_swaying.metrics import frechet_video
from gaussian_swaying.metrics.frechet_video import FrechetVideoDistance, cut_clips, frechet_distance

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


class Means(nn.Module):
    """Features of a clip: mean over all pixels of the first frame and of the last, from -1 to 1."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.stack([x[:, :, 0].mean(dim=[1, 2, 3]), x[:, :, -1].mean(dim=[1, 2, 3])], dim=1)


class WithOptions(nn.Module):
    """Called as the I3D of StyleGAN-V: anything but features if it is not told otherwise."""

    def forward(self, x: Tensor, rescale: bool = True, resize: bool = True, return_features: bool = False) -> Tensor:
        if rescale or resize or not return_features:
            return torch.zeros(x.shape[0], 400, 7)
        return x.mean(dim=[3, 4]).flatten(1)


class WrongShape(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x.mean(dim=[3, 4])


class WrongRows(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x.mean(dim=[0, 3, 4]).flatten()[None]


@pytest.fixture
def make(tmp_path):
    """The metric with a network saved as TorchScript."""

    def _make(network=None, **options):
        path = tmp_path / "network.pt"
        torch.jit.script(network or Means()).save(str(path))
        return FrechetVideoDistance(path, **({"clip_length": 2, "stride": 2, "resize": 8} | options))

    return _make


def _covariance(size):
    root = randn(size, size)
    return root @ root.mT


# ---- between Gaussians


def test_equal_gaussians_have_no_distance(device):
    mean, cov = randn(20, device=device), _covariance(20).to(device)
    # eigenvalues are good to eps |S|^2, whose root is taken where they vanish: 20 sqrt(eps) |S| at most
    bound = 20 * math.sqrt(torch.finfo(torch.float64).eps) * float(cov.norm())
    assert 0 <= frechet_distance(mean, cov, mean, cov) < bound


def test_diagonal_gaussians():
    """Sum of squared differences of means and of standard deviations."""
    mean1, mean2 = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([0.0, 1.0, 0.5])
    std1, std2 = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 0.5, 3.0])
    found = frechet_distance(mean1, std1.square().diag(), mean2, std2.square().diag())
    assert float(found) == pytest.approx(10.0 + 1.0 + 2.25, rel=1e-12)


def test_covariances_that_do_not_commute():
    """In two dimensions tr sqrt(A B) = sqrt(tr(A B) + 2 sqrt(det(A B)))."""
    a, b = double([[2.0, 0.6], [0.6, 1.0]]), double([[1.0, -0.8], [-0.8, 3.0]])
    product = a @ b
    root = math.sqrt(float(product.trace()) + 2 * math.sqrt(float(torch.linalg.det(product))))
    expected = float(a.trace() + b.trace()) - 2 * root
    zero = torch.zeros(2)
    assert not torch.allclose(product, b @ a)
    assert float(frechet_distance(zero, a, zero, b)) == pytest.approx(expected, rel=1e-12)


def test_invariance_under_rotation_and_order():
    cov1, cov2 = _covariance(6), _covariance(6)
    mean1, mean2 = randn(2, 6)
    turn = torch.linalg.qr(randn(6, 6)).Q
    one = frechet_distance(mean1, cov1, mean2, cov2)
    assert_close(frechet_distance(mean2, cov2, mean1, cov1), one)
    turned = frechet_distance(turn @ mean1, turn @ cov1 @ turn.mT, turn @ mean2, turn @ cov2 @ turn.mT)
    assert_close(turned, one)


def test_singular_covariances():
    """Fewer samples than dimensions: along u and v, tr sqrt(A B) = |u.v| s t for A = s^2 u u^T, B = t^2 v v^T."""
    size, s, t, angle = 50, 3.0, 0.5, 0.7
    u, v = torch.zeros(2, size).double()
    u[0], v[0], v[1] = 1.0, math.cos(angle), math.sin(angle)
    found = frechet_distance(u, s**2 * torch.outer(u, u), u, t**2 * torch.outer(v, v))
    # 49 eigenvalues that should be 0 are up to eps (s t)^2, and their roots are added
    tolerance = 2 * size * math.sqrt(torch.finfo(torch.float64).eps) * s * t
    assert float(found) == pytest.approx(s**2 + t**2 - 2 * s * t * math.cos(angle), abs=tolerance)


@pytest.mark.parametrize(
    ("shapes", "name"),
    [
        (((3,), (3, 2), (3,), (3, 3)), "cov1"),
        (((3,), (3, 3), (2,), (3, 3)), "mean2"),
        (((3,), (3, 3), (3,), (3,)), "cov2"),
    ],
)
def test_shapes_that_do_not_fit(shapes, name):
    with value_error(f"Expected `{name}` of shape"):
        frechet_distance(*(torch.ones(shape) for shape in shapes))


# ---- between videos


def test_clips_begin_every_stride_frames():
    video = torch.arange(9.0)[:, None, None, None].expand(9, 3, 2, 2)
    clips = cut_clips(video, 4, 2)
    assert clips.shape == (3, 4, 3, 2, 2)
    assert clips[:, :, 0, 0, 0].tolist() == [[0, 1, 2, 3], [2, 3, 4, 5], [4, 5, 6, 7]]


def test_videos_with_known_features(make, monkeypatch):
    """Grey frames: a clip's features are its first and last grey, mapped to -1 to 1; moments follow by hand."""
    monkeypatch.setattr(frechet_video, "BATCH", 4)
    real, fake = torch.rand(12), torch.rand(12)
    metric = make()
    for greys, is_real in ((real, True), (fake, False)):
        metric.update(greys[:, None, None, None].expand(-1, 3, 5, 7), real=is_real)
    moments = []
    for greys in (real, fake):
        features = (2 * greys.double() - 1).reshape(6, 2)
        away = features - features.mean(0)
        moments += [features.mean(0), away.mT @ away / 5]
    # float32 features of order 1 in a distance that is quadratic in them
    assert float(metric.compute()) == pytest.approx(float(frechet_distance(*moments)), abs=1e-5)
    assert metric.compute() > 0.01


def test_pieces_and_batches_accumulate(make):
    videos = torch.rand(3, 6, 3, 8, 8)
    batch, single = make(), make()
    batch.update(videos, real=True)
    for video in videos:
        single.update(video, real=True)
    for metric in (batch, single):
        metric.update(videos.flip(0).square(), real=False)
    assert_close(batch.compute(), single.compute())
    assert batch.protocol()["real_clips"] == 9
    batch.reset()
    assert batch.protocol()["real_clips"] == 0


def test_frames_may_be_resized_one_by_one(make):
    video = torch.rand(6, 3, 20, 30)
    whole, pieces = make(WithOptions(), resize=(6, 10)), make(WithOptions(), resize=(6, 10))
    whole.update(video, real=True)
    small = torch.stack([pieces.prepare(frame) for frame in video])
    assert small.shape == (6, 3, 6, 10)
    pieces.update(small, real=True)
    assert torch.equal(torch.cat(whole.real_features), torch.cat(pieces.real_features))
    assert whole.protocol()["features"] == 3 * 2
    assert make(resize=None).prepare(video).shape == video.shape


def test_protocol_names_all_that_the_number_depends_on(make, tmp_path):
    metric = make(clip_length=3, stride=2, resize=(8, 12))
    metric.update(torch.rand(9, 3, 8, 12), real=True)
    metric.update(torch.rand(7, 3, 8, 12), real=False)
    found = metric.protocol()
    assert found["weights_sha256"] == hashlib.sha256((tmp_path / "network.pt").read_bytes()).hexdigest()
    assert found["weights"] == "network.pt"
    assert (found["clip_length"], found["stride"], found["resize"]) == (3, 2, [8, 12])
    assert (found["real_clips"], found["generated_clips"], found["features"]) == (4, 3, 2)
    line = metric.describe()
    assert line.startswith(f"FVD {float(metric.compute()):.5g} (")
    for name, value in found.items():
        assert f"{name} {value}" in line


@pytest.mark.gpu
def test_the_network_follows_the_metric(make):
    videos = torch.rand(2, 8, 3, 8, 8)
    values = []
    for device in ("cpu", "cuda"):
        metric = make().to(device)
        metric.update(videos[0], real=True)
        metric.update(videos[1], real=False)
        values.append(metric.compute().cpu())
    assert_close(*values, rtol=1e-4, atol=1e-6)


# ---- bad input


def test_missing_weights(tmp_path):
    with value_error(r"There is no file .*i3d\.pt: set `weights` .* none is downloaded"):
        FrechetVideoDistance(tmp_path / "i3d.pt")


def test_weights_that_are_not_torchscript(tmp_path):
    (tmp_path / "i3d.pt").write_bytes(b"not a network")
    with value_error(r"i3d\.pt cannot be read as TorchScript"):
        FrechetVideoDistance(tmp_path / "i3d.pt")


@pytest.mark.parametrize("network", [WrongShape(), WrongRows()])
def test_network_with_another_output(make, network):
    metric = make(network)
    with value_error(r"to return features of shape \(3, D\) for 3 clips, but got"):
        metric.update(torch.rand(6, 3, 8, 8), real=True)
    assert metric.protocol()["real_clips"] == 0


def test_video_shorter_than_a_clip(make):
    with value_error("A video has 3 frames, but a clip needs 4"):
        make(clip_length=4).update(torch.rand(3, 3, 8, 8), real=True)


@pytest.mark.parametrize(("real", "fake", "named"), [(2, 8, "real"), (8, 2, "generated"), (0, 8, "real")])
def test_too_few_clips(make, real, fake, named):
    metric = make()
    for count, is_real in ((real, True), (fake, False)):
        if count:
            metric.update(torch.rand(count, 3, 8, 8), real=is_real)
    message = f"at least 2 {named} clips, but there are {min(real, fake) // 2}"
    with value_error(message):
        metric.compute()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_length": 0}, "Expected `clip_length` to be positive"),
        ({"stride": 0}, "Expected `stride` to be positive"),
        ({"resize": (8, 0)}, "Expected `resize` to be positive"),
        ({"resize": (8, 8, 8)}, "Expected `resize` to be height and width"),
    ],
)
def test_bad_options(make, options, message):
    with value_error(message):
        make(**options)


@pytest.mark.parametrize("shape", [(4, 8, 8, 3), (4, 8, 8), (1, 1, 4, 3, 8, 8)])
def test_bad_videos(make, shape):
    with value_error("Expected `video` of shape"):
        make().update(torch.rand(shape), real=True)
    for changed in (-0.1, 1.1):
        with value_error("values from 0 to 1, but they range from"):
            make().update(torch.full((4, 3, 8, 8), changed), real=True)
