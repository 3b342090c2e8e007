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


def _rgb(x, y, *weight):
    return PhotometricLoss(*weight)(_inputs(image=x, target=y))


def test_photometric_loss_is_the_weighted_sum():
    x, y = _pictures()
    expected = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim_map(x, y).mean())
    assert_close(_rgb(x, y), expected)
    assert_close(_rgb(x, y, 0.0), (x - y).abs().mean())
    assert float(_rgb(x, x)) == pytest.approx(0.0, abs=1e-12)


def test_photometric_gradient():
    x, y = _pictures(12, 13)
    assert torch.autograd.gradcheck(lambda p: _rgb(p, y), x.requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0], [2, 1, 0]])
def test_anisotropy_by_hand(order):
    """It leaves discs alone."""
    inputs = _inputs(log_scales=double([[0.3, 0.2, 0.001], [0.2, 0.2, 0.001], [0.21, 0.2, 0.2]])[:, order].log())
    assert_close(AnisotropyLoss().of_each(inputs), double([0.4, 0.0, 0.0]))
    assert_close(AnisotropyLoss()(inputs), double(0.4 / 3))
    assert_close(AnisotropyLoss(reduction="sum")(inputs), double(0.4))


def test_entropy_by_hand():
    values = double([0.0, 1.0, 0.5, 1 / math.e]).requires_grad_()
    result = OpacityEntropyLoss().of_each(_inputs(opacities=values))
    expected = double([0.0, 0.0, 0.5 * math.log(2), 1 / math.e])
    assert_close(result, expected, rtol=1e-9, atol=2e-6)
    result.sum().backward()
    assert torch.isfinite(values.grad).all()
    assert (values.grad[1:3] < 0).all()  # descent raises an opacity above 1/e
    mean = OpacityEntropyLoss()(_inputs(opacities=torch.tensor([0.1, 0.9])))
    assert mean.item() == pytest.approx(0.16252, abs=1e-4)


def test_size_by_hand():
    inputs = _inputs(log_scales=double([[0.001, 0.010, 0.002], [0.008, 0.001, 0.001]]).log())
    assert_close(SizeLoss().of_each(inputs), double([0.002, 0.0]))
    assert SizeLoss(b=0.0)(inputs).item() == pytest.approx(0.009)
    assert (MeanOpacityLoss()(_inputs()).item(), MeanScaleLoss()(_inputs()).item()) == pytest.approx((0.5, 0.017))


def test_no_gaussians_cost_nothing():
    none = _inputs(log_scales=torch.zeros(0, 3), opacities=torch.zeros(0))
    assert [term()(none).item() for term in (AnisotropyLoss, OpacityEntropyLoss, SizeLoss)] == [0.0] * 3


def test_scale_gradients():
    for term in (AnisotropyLoss(), SizeLoss()):
        assert torch.autograd.gradcheck(lambda s, t=term: t(_inputs(log_scales=s)), randn(6, 3, requires_grad=True))


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
        (lambda: SizeLoss(-1.0), "`b`"),
        (lambda: SizeLoss(reduction="max"), "one of mean, sum"),
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
