"""Optimisers of the Gaussians."""

import pytest
import torch

from gaussian_swaying.rendering.protocol import ScreenGaussians
from gaussian_swaying.training.optimizers import make_optimizer, step_all


def test_fused_adams_step_as_torch_does():
    """Bit for bit, with rates that change, a parameter without gradient, and more Gaussians half way through."""

    def run(step):
        torch.manual_seed(0)
        parameters = [torch.nn.Parameter(torch.randn(7, *shape)) for shape in ((3,), (), (4, 3))]
        optimizers = [torch.optim.Adam([p], lr=0.01 * (i + 1), eps=1e-15, fused=True) for i, p in enumerate(parameters)]
        for turn in range(6):
            optimizers[0].param_groups[0]["lr"] = 0.01 * 0.9**turn
            for index, parameter in enumerate(parameters):
                parameter.grad = None if index == 1 and turn == 3 else torch.randn_like(parameter)
            step(optimizers)
        return [*parameters, *(value for o in optimizers for s in o.state.values() for value in s.values())]

    expected = run(lambda optimizers: [optimizer.step() for optimizer in optimizers])
    for one, two in zip(run(step_all), expected, strict=True):
        assert torch.equal(one, two)


def test_other_adams_step_themselves():
    parameter = torch.nn.Parameter(torch.ones(3))
    optimizer = make_optimizer(parameter, 0.1)
    parameter.grad = torch.ones(3)
    step_all([optimizer])
    assert parameter.tolist() == pytest.approx([0.9] * 3)


def test_the_selective_one_needs_a_gpu():
    with pytest.raises(ValueError, match="`optimizer` selective_adam needs CUDA"):
        make_optimizer(torch.ones(3), 0.1, "selective_adam")


@pytest.mark.gpu
def test_the_selective_one_moves_what_was_seen():
    parameter = torch.nn.Parameter(torch.ones(4, 3, device="cuda"))
    optimizer = make_optimizer(parameter, 0.1, "selective_adam")
    parameter.grad = torch.ones_like(parameter)
    step_all([optimizer], torch.tensor([True, False, True, False], device="cuda"))
    assert (parameter[[1, 3]] == 1).all()
    assert (parameter[[0, 2]] < 1).all()


def test_which_gaussians_a_picture_shows():
    """From all of them, and from a list of those that were drawn."""
    radii = torch.tensor([[2, 3], [0, 1], [4, 1]])
    everything = ScreenGaussians(torch.zeros(1, 3, 2), radii[None], None, 8, 8)
    assert everything.seen(3).tolist() == [True, False, True]
    listed = ScreenGaussians(torch.zeros(3, 2), radii, torch.tensor([4, 0, 2]), 8, 8)
    assert listed.seen(5).tolist() == [False, False, True, False, True]
