import pytest
import torch
from shared import seeded, value_error

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.protocol import ScreenGaussians
from gaussian_swaying.training.densification import (
    PARAMETERS,
    DefaultDensification,
    MCMCDensification,
)
from gaussian_swaying.training.initial import gaussians_from_points


def _model(count=6, opacity=0.5):
    points = torch.arange(count, dtype=torch.float32)[:, None].repeat(1, 3)
    return GaussianSurfaceModel.from_cloud(gaussians_from_points(points, torch.rand(count, 3), 1, opacity, 1e-3))


def _optimizer(model):
    optimizer = torch.optim.Adam([{"params": [getattr(model, name)]} for name in PARAMETERS], lr=1e-3)
    for name in PARAMETERS:
        getattr(model, name).grad = torch.ones_like(getattr(model, name))
    optimizer.step()
    return optimizer


def _group(optimizer, name):
    return optimizer.param_groups[PARAMETERS.index(name)]


def _screen(gradient, index):
    means2d = torch.zeros(len(index), 2, requires_grad=True) * 1.0
    means2d.retain_grad()
    means2d.grad = torch.tensor(gradient)[:, None] * torch.tensor([[1.0, 0.0]])
    return ScreenGaussians(means2d, torch.ones(len(index), 2), torch.tensor(index), 2, 2)


def test_copies_splits_and_removes():
    """By hand: 1 is copied, 3 is large and split, 5 is faint and removed, the rest has no gradient."""
    model = _model()
    with torch.no_grad():
        model.scales[3] = 0.0
        model.opacities[5] = -9.0
    optimizer = _optimizer(model)
    moved = model.means.detach().clone()
    densification = DefaultDensification(start=0, every=2, grow_grad2d=0.5, grow_scale3d=0.1, prune_scale3d=10.0)
    densification.attach(model, optimizer, 1.0)
    densification.after_step(1, _screen([2.0, 2.0, 0.1], [1, 3, 4]))
    assert len(model) == 6
    assert densification.state_dict()["count"].tolist() == [0, 1, 0, 1, 1, 0]
    densification.after_step(2, _screen([2.0, 2.0], [1, 3]))
    assert len(model) == 7  # 6 + a copy + a half - a faint one
    means = model.means.detach()
    assert sum(torch.allclose(row, moved[1]) for row in means) == 2
    assert not any(torch.allclose(row, moved[5]) for row in means)
    assert float(model.scales.detach().max()) == pytest.approx(-torch.tensor(1.6).log().item(), abs=2e-3)
    for name in PARAMETERS:
        parameter = getattr(model, name)
        assert _group(optimizer, name)["params"][0] is parameter
        assert optimizer.state[parameter]["exp_avg"].shape == parameter.shape
        assert dict(model.named_parameters())[name] is parameter
    assert densification.state_dict()["grad2d"].eq(0).all()
    assert len(densification.state_dict()["grad2d"]) == 7


def test_all_gaussians_at_once():
    model = _model()
    densification = DefaultDensification(start=0, every=100)
    densification.attach(model, _optimizer(model), 1.0)
    means2d = torch.zeros(1, 6, 2, requires_grad=True) * 1.0
    means2d.retain_grad()
    means2d.grad = torch.ones(1, 6, 2)
    radii = torch.tensor([3, 0, 2, 0, 1, 1])[None, :, None].expand(1, 6, 2)
    densification.after_step(1, ScreenGaussians(means2d, radii, None, 2, 2))
    assert densification.state_dict()["count"].tolist() == [1, 0, 1, 0, 1, 1]


def test_what_needs_cuda_says_so():
    model = _model()
    with value_error(r"MCMCDensification needs CUDA.*use DefaultDensification"):
        MCMCDensification().attach(model, _optimizer(model), 1.0)


@pytest.mark.gpu
def test_mcmc_adds_up_to_its_cap():
    model = _model(100).cuda()
    densification = MCMCDensification(cap=103, start=0, every=1)
    densification.attach(model, _optimizer(model), 1.0)
    for step in (1, 2):
        densification.after_step(step, ScreenGaussians(torch.zeros(1, 100, 2), torch.zeros(1, 100, 2), None, 2, 2))
    assert len(model) == 103


def test_foreign_optimizers_are_refused():
    model = _model()
    optimizer = _optimizer(model)
    one_group = torch.optim.Adam([getattr(model, name) for name in PARAMETERS])
    short = _optimizer(model)
    del short.param_groups[-1]
    for foreign, other in ((optimizer, _model()), (one_group, model), (short, model)):
        with value_error("one group for each of means, scales, quats, opacities, sh0, shN of the"):
            DefaultDensification().attach(other, foreign, 1.0)


def test_large_ones_are_split_once():
    model = _model(3, opacity=0.9)
    with torch.no_grad():
        model.scales.copy_(torch.tensor([[0.02, 0.02, 1e-3]]).log().expand(3, 3))
        model.scales[1] = torch.tensor([0.3, 0.1, 1e-3]).log()
        model.means.mul_(2.0)  # apart
        model.opacities[0] = 30.0  # opaque to the last bit
    optimizer = _optimizer(model)
    opacities = model.opacities.detach().clone()
    momenta = {name: optimizer.state[getattr(model, name)]["exp_avg"].clone() for name in PARAMETERS}
    densification = DefaultDensification(start=0, stop=5, split_at=7, split_size=0.05)
    densification.attach(model, optimizer, 1.0)
    for step in (5, 6):
        densification.after_step(step, _screen([0.0], [0]))
    assert len(model) == 3
    densification.after_step(7, _screen([0.0], [0]))
    count = len(model)
    assert count > 10
    assert torch.equal(model.opacities.detach()[:3], opacities)
    assert torch.isfinite(model.opacities).all()
    assert model.scales.detach().exp().max() <= 0.05
    offset = model.means.detach()[3:] - model.means.detach()[1]
    assert (offset[:, 0].abs() < 0.6).all()
    assert (offset[:, 2].abs() < 0.01).all()
    assert torch.equal(model.sh0.detach()[3:], model.sh0.detach()[1:2].expand(count - 3, 1, 3))
    for name in PARAMETERS:
        parameter = getattr(model, name)
        assert _group(optimizer, name)["params"][0] is parameter
        assert dict(model.named_parameters())[name] is parameter
        state = optimizer.state[parameter]["exp_avg"]
        assert state.shape == parameter.shape
        assert torch.equal(state[:3], momenta[name])
        assert not state[3:].any()
    before = {name: getattr(model, name).detach().clone() for name in PARAMETERS}
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert [name for name in PARAMETERS if torch.equal(getattr(model, name), before[name])] == ["quats"]  # held
    with torch.no_grad():
        model.scales.add_(1.0)
    densification.after_step(8, _screen([0.0], [0]))
    assert len(model) == count
    assert model.scales.detach().exp().max() <= 0.05 * (1 + 1e-6)


def test_sums_of_gradients_without_waiting_are_those_of_gsplat():
    """The same sums and counts, bit for bit, over pictures that show different Gaussians."""
    from gsplat import DefaultStrategy

    ours, theirs = DefaultDensification().make_strategy(torch.device("cpu")), DefaultStrategy()
    parameters = {"means": torch.zeros(50, 3)}
    states = [strategy.initialize_state(scene_scale=1.0) for strategy in (ours, theirs)]
    generator = seeded(0)
    for _ in range(4):
        means2d = torch.rand(1, 50, 2, generator=generator)
        means2d.grad = torch.randn(1, 50, 2, generator=generator)
        radii = torch.randint(0, 3, (1, 50, 2), generator=generator)
        info = {"means2d": means2d, "radii": radii, "gaussian_ids": None, "width": 96, "height": 54, "n_cameras": 1}
        for strategy, state in zip((ours, theirs), states, strict=True):
            strategy._update_state(parameters, state, info)
    assert states[1]["count"].unique().numel() > 2
    for name in ("grad2d", "count"):
        assert torch.equal(states[0][name], states[1][name])
