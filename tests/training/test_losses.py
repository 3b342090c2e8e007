import math

import pytest
import torch
from shared import double, randn, value_error
from torch.testing import assert_close

from gaussian_swaying.metrics.ssim import ssim_map
from gaussian_swaying.training.losses import (
    AnisotropyLoss,
    LossInputs,
    LossTerm,
    MeanOpacityLoss,
    MeanScaleLoss,
    OpacityEntropyLoss,
    PhotometricLoss,
    SizeLoss,
    TotalLoss,
    anisotropy_loss,
    opacity_entropy_loss,
    photometric_loss,
    size_loss,
)


def _pictures(height=24, width=31, dtype=torch.float64):
    x = torch.rand(height, width, 3, dtype=dtype)
    return x, (x + 0.2 * torch.randn_like(x)).clamp(0, 1)


def _inputs(**changes):
    image, target = _pictures(dtype=torch.float32)
    fields = {
        "image": image,
        "target": target,
        "alpha": torch.ones(24, 31, 1),
        "target_alpha": None,
        "means": torch.rand(5, 3),
        "quats": torch.rand(5, 4),
        "log_scales": torch.tensor([0.03, 0.02, 0.001]).log().repeat(5, 1),
        "opacities": torch.full((5,), 0.5),
        "step": 3,
    }
    return LossInputs(**(fields | changes))


def test_photometric_loss_is_the_weighted_sum():
    x, y = _pictures()
    expected = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim_map(x, y).mean())
    assert_close(photometric_loss(x, y), expected)
    assert_close(photometric_loss(x, y, ssim_weight=0.0), (x - y).abs().mean())
    assert float(photometric_loss(x, x)) == pytest.approx(0.0, abs=1e-12)
    padded = 0.8 * (x - y).abs() + 0.2 * (1 - ssim_map(x, y, "zeros"))
    assert padded.shape == x.shape
    assert_close(padded.mean(), photometric_loss(x, y, padding="zeros"))


def test_photometric_gradient():
    x, y = _pictures(12, 13)
    assert torch.autograd.gradcheck(lambda p: photometric_loss(p, y), x.requires_grad_(), fast_mode=True)


def _of_each(loss, values):
    return torch.stack([loss(one) for one in values.split(1)])


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0], [2, 1, 0]])
def test_anisotropy_by_hand(order):
    """The paper's ratio leaves discs alone, PhysGaussian's does not."""
    scales = double([[0.3, 0.2, 0.001], [0.2, 0.2, 0.001], [0.21, 0.2, 0.2]])[:, order].log()
    literal = _of_each(anisotropy_loss, scales)
    assert_close(literal, double([0.4, 0.0, 0.0]))
    spread = _of_each(lambda one: anisotropy_loss(one, ratio="max_min"), scales)
    assert_close(spread, double([298.9, 198.9, 0.0]))
    assert_close(anisotropy_loss(scales), literal.mean())
    assert_close(anisotropy_loss(scales, reduction="sum"), literal.sum())


def test_entropy_by_hand():
    values = double([0.0, 1.0, 0.5, 1 / math.e]).requires_grad_()
    result = _of_each(opacity_entropy_loss, values)
    expected = double([0.0, 0.0, 0.5 * math.log(2), 1 / math.e])
    assert_close(result, expected, rtol=1e-9, atol=2e-6)
    result.sum().backward()
    assert torch.isfinite(values.grad).all()
    assert (values.grad[1:3] < 0).all()  # descent raises an opacity above 1/e
    assert opacity_entropy_loss(torch.tensor([0.1, 0.9])).item() == pytest.approx(0.16252, abs=1e-4)


def test_size_by_hand():
    scales = double([[0.001, 0.010, 0.002], [0.008, 0.001, 0.001]]).log()
    assert_close(_of_each(size_loss, scales), double([0.002, 0.0]))
    assert size_loss(scales, b=0.0).item() == pytest.approx(0.009)


def test_no_gaussians_cost_nothing():
    assert anisotropy_loss(torch.zeros(0, 3)).item() == 0.0
    assert opacity_entropy_loss(torch.zeros(0)).item() == 0.0
    assert size_loss(torch.zeros(0, 3)).item() == 0.0


def test_scale_gradients():
    scales = randn(6, 3, requires_grad=True)
    for function in (anisotropy_loss, lambda s: anisotropy_loss(s, ratio="max_min"), size_loss):
        assert torch.autograd.gradcheck(function, scales)


def test_modules_are_their_functions():
    inputs = _inputs()
    pairs = [
        (PhotometricLoss(0.4, "zeros"), photometric_loss(inputs.image, inputs.target, 0.4, "zeros")),
        (AnisotropyLoss(1.2, "max_min"), anisotropy_loss(inputs.log_scales, 1.2, "max_min")),
        (OpacityEntropyLoss(), opacity_entropy_loss(inputs.opacities)),
        (SizeLoss(0.01), size_loss(inputs.log_scales, 0.01)),
        (AnisotropyLoss(reduction="sum"), anisotropy_loss(inputs.log_scales, reduction="sum")),
        (OpacityEntropyLoss("sum"), opacity_entropy_loss(inputs.opacities, "sum")),
        (SizeLoss(reduction="sum"), size_loss(inputs.log_scales, reduction="sum")),
        (MeanOpacityLoss(), torch.tensor(0.5)),
        (MeanScaleLoss(), torch.tensor(0.017)),
    ]
    for module, expected in pairs:
        assert_close(module(inputs), expected)


def test_total_with_the_weights_of_the_paper():
    inputs = _inputs()
    total, terms = TotalLoss()(inputs)
    assert list(terms) == ["rgb", "anisotropy", "entropy", "size"]
    expected = terms["rgb"] + 10 * terms["anisotropy"] + 0.01 * terms["entropy"] + 0.01 * terms["size"]
    assert_close(total, expected)
    assert terms["anisotropy"].item() == pytest.approx(0.4, abs=1e-6)


class _Each(LossTerm):
    """A term that is no number."""

    def forward(self, inputs):
        return inputs.opacities


class Steps(LossTerm):
    """A custom term."""

    def forward(self, inputs):
        return inputs.means.new_tensor(float(inputs.step))


def test_total_with_a_term_of_ones_own():
    total, terms = TotalLoss({"steps": Steps()}, {"steps": 2.0, "rgb": 0, "anisotropy": 0, "size": 0})(_inputs())
    assert list(terms) == ["entropy", "steps"]
    assert total.item() == pytest.approx(6.0 + 0.01 * 0.5 * math.log(2), rel=1e-5)
    other = TotalLoss({"size": SizeLoss(0.0)}, {"rgb": 0, "anisotropy": 0, "entropy": 0})(_inputs())[0]
    assert other.item() == pytest.approx(0.01 * 0.03)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TotalLoss(weights={"depth": 1.0}), r"`loss_weights` for rgb.*but got one for depth"),
        (lambda: TotalLoss(weights={"size": math.nan}), "`loss_weights.size` to be finite"),
        (lambda: TotalLoss(weights={"rgb": 0, "anisotropy": 0, "entropy": 0, "size": 0}), "not to be zero"),
        (lambda: PhotometricLoss(1.5), "`ssim_weight` between 0 and 1"),
        (lambda: AnisotropyLoss(0.5), "`a` to be at least 1"),
        (lambda: AnisotropyLoss(ratio="min_max"), "paper, max_min"),
        (lambda: SizeLoss(-1.0), "`b`"),
        (lambda: SizeLoss(reduction="max"), "one of mean, sum"),
        (lambda: AnisotropyLoss(reduction="max"), "one of mean, sum"),
        (lambda: OpacityEntropyLoss("max"), "one of mean, sum"),
        (lambda: TotalLoss({"each": _Each()})(_inputs()), "`each` to be a number.*the mean or the sum"),
    ],
)
def test_bad_terms(make, words):
    with value_error(words):
        make()


class _Ones(LossTerm):
    """One, whenever it is asked."""

    def forward(self, inputs):
        return inputs.log_scales.sum() * 0.0 + 1.0


def test_terms_at_some_images_with_a_weight_that_fades():
    term = _Ones()
    term.start, term.stop, term.fade, term.every = 4, 12, 4, 2
    total = TotalLoss({"one": term}, {"rgb": 0.0, "anisotropy": 0.0, "entropy": 0.0, "size": 0.0, "one": 0.5})
    found = [float(total(_inputs(step=step))[0]) for step in range(15)]
    assert found == [0, 0, 0, 0, 1, 0, 1, 0, 1, 0, 0.5, 0, 0, 0, 0]
    assert [bool(total.active(step)) for step in (3, 4, 5, 10, 12)] == [False, True, False, True, False]
    assert [_Ones().share(step) for step in (0, 1, 99)] == [1.0] * 3
