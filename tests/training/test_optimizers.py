"""The optimiser of the Gaussians."""

import pytest
import torch
from shared import value_error

from gaussian_swaying.rendering.protocol import ScreenGaussians
from gaussian_swaying.training.optimizers import GaussianAdam
from gaussian_swaying.training.parallel import scaled_adam


def test_fused_adam_steps_as_torch_does():
    """Bit for bit, with rates that change, a parameter without gradient, and more Gaussians half way through."""

    def run(kind):
        torch.manual_seed(0)
        parameters = [torch.nn.Parameter(torch.randn(7, *shape)) for shape in ((3,), (), (4, 3))]
        optimizer = GaussianAdam(parameters, [0.01, 0.02, 0.03])
        for group in optimizer.param_groups:
            group["fused"] = True
        for turn in range(6):
            optimizer.param_groups[0]["lr"] = 0.01 * 0.9**turn
            for index, parameter in enumerate(parameters):
                parameter.grad = None if index == 1 and turn == 3 else torch.randn_like(parameter)
            assert kind.step(optimizer, lambda: 5) == 5
        return [*parameters, *(value for state in optimizer.state.values() for value in state.values())]

    for one, two in zip(run(GaussianAdam), run(torch.optim.Adam), strict=True):
        assert torch.equal(one, two)


def test_one_adam_is_six():
    """Each group steps as an Adam of its own, with its rate and the options of several devices."""
    torch.manual_seed(0)
    parameters = [torch.nn.Parameter(torch.randn(5, count)) for count in (3, 1)]
    alone = [torch.nn.Parameter(parameter.detach().clone()) for parameter in parameters]
    optimizer = GaussianAdam(parameters, [0.1, 0.3], devices=4)
    others = [torch.optim.Adam([p], **scaled_adam(rate, 4)) for p, rate in zip(alone, (0.1, 0.3), strict=True)]
    for _ in range(3):
        for one, two in zip(parameters, alone, strict=True):
            one.grad = torch.randn_like(one)
            two.grad = one.grad.clone()
        optimizer.step()
        for other in others:
            other.step()
    for one, two in zip(parameters, alone, strict=True):
        assert torch.equal(one, two)
    optimizer.zero_grad()
    optimizer.step()  # nothing to do
    assert torch.equal(parameters[0], alone[0])


def test_the_selective_one_needs_a_gpu():
    with value_error("`optimizer` selective_adam needs CUDA"):
        GaussianAdam([torch.ones(3)], [0.1], "selective_adam")


@pytest.mark.gpu
def test_the_selective_one_moves_what_was_seen():
    parameter = torch.nn.Parameter(torch.ones(4, 3, device="cuda"))
    optimizer = GaussianAdam([parameter], [0.1], "selective_adam")
    parameter.grad = torch.ones_like(parameter)
    optimizer.step(seen=torch.tensor([True, False, True, False], device="cuda"))
    assert (parameter[[1, 3]] == 1).all()
    assert (parameter[[0, 2]] < 1).all()


def test_which_gaussians_a_picture_shows():
    """From all of them, and from a list of those that were drawn."""
    radii = torch.tensor([[2, 3], [0, 1], [4, 1]])
    everything = ScreenGaussians(torch.zeros(1, 3, 2), radii[None], None, 8, 8)
    assert everything.seen(3).tolist() == [True, False, True]
    listed = ScreenGaussians(torch.zeros(3, 2), radii, torch.tensor([4, 0, 2]), 8, 8)
    assert listed.seen(5).tolist() == [False, False, True, False, True]
