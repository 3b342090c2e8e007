import torch

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
