import math

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from shared import peak, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.training.densification import (
    PARAMETERS,
    DefaultDensification,
    MCMCDensification,
)
from gaussian_swaying.training.initial import gaussians_from_points
from gaussian_swaying.training.losses import LossTerm, MeanOpacityLoss, MeanScaleLoss
from gaussian_swaying.training.module import SplatTrainer, TrainingDiverged
from gaussian_swaying.training.optimizers import LearningRates, means_rate


def _often():
    """A densification that acts every four steps: in the middle of its sums after ten."""
    return DefaultDensification(start=1, every=4, grow_grad2d=1e-4, reset_every=8)


def _module(**options):
    return SplatTrainer(**({"sh_degree": 1, "sh_every": 7, "densification": _often()} | options))


def _checkpoints(folder, every=10, **options):
    return ModelCheckpoint(dirpath=folder, every_n_train_steps=every, save_top_k=-1, filename="{step}", **options)


def _learned(trainer, module, data):
    start = trainer.validate(module, data, verbose=False)[0]
    trainer.fit(module, data)
    return start, trainer.validate(module, data, verbose=False)[0]


def test_a_training_learns(data, make_trainer, tmp_path):
    """More than 6 dB in 200 images on held-out views, with Gaussians that multiply and become flat."""
    module = _module(densification=DefaultDensification(start=20, every=50, grow_grad2d=5e-4), sh_every=100)
    trainer = make_trainer(200, limit_val_batches=1.0, val_check_interval=100, num_sanity_val_steps=0)
    start, end = _learned(trainer, module, data)
    assert end["val/psnr"] >= start["val/psnr"] + 6.0
    assert end["val/ssim"] > start["val/ssim"]
    assert trainer.global_step == 200
    assert len(module.splat) > data.points
    scales = module.splat.scales.detach().sort(-1).values.exp()
    assert (scales[:, 2] / scales[:, 1]).median() < 1.2
    cloud = read_ply(tmp_path / "run" / "point_cloud.ply")
    assert len(cloud) == len(module.splat)
    assert_close(cloud.means, module.splat.means.detach())
    assert {path.name for path in (tmp_path / "run" / "panels").iterdir()} >= {"val_00_000100.png", "val_01_000200.png"}


def _state(module):
    result = {name: getattr(module.splat, name).detach() for name in PARAMETERS}
    (optimizer,) = module.trainer.optimizers
    for name, group in zip(PARAMETERS, optimizer.param_groups, strict=True):
        (parameter,) = group["params"]
        result |= {f"{name}.{key}": value for key, value in optimizer.state[parameter].items()}
        result[f"{name}.lr"] = torch.tensor(group["lr"])
    state = module.densification.state_dict()
    return result | {key: value for key, value in state.items() if isinstance(value, torch.Tensor)}


def test_a_resumed_training_is_the_same_bit_for_bit(data, make_trainer, tmp_path):
    """20 images at once, or 10, a checkpoint and 10, with Gaussians that split and vanish in both halves."""
    torch.manual_seed(1)
    straight = _module()
    make_trainer(20).fit(straight, data)
    torch.manual_seed(2)
    first = _module()
    trainer = make_trainer(20, enable_checkpointing=True, callbacks=[_checkpoints(tmp_path / "c"), _StopAt(10)])
    trainer.fit(first, data)
    assert trainer.global_step == 10
    count = len(first.splat)
    assert count != data.points
    torch.manual_seed(3)
    second = _module()
    make_trainer(20).fit(second, data, ckpt_path=tmp_path / "c" / "step=10.ckpt", weights_only=False)
    assert len(second.splat) != count
    expected, result = _state(straight), _state(second)
    assert result.keys() == expected.keys()
    assert len(expected) > 20
    for name, value in expected.items():
        assert torch.equal(result[name], value), name


def test_a_checkpoint_with_six_optimizers_is_refused(data, make_trainer, tmp_path):
    path = tmp_path / "step=2.ckpt"
    trainer = make_trainer(2, enable_checkpointing=True, callbacks=[_checkpoints(tmp_path, every=2)])
    trainer.fit(_module(), data)
    old = torch.load(path, weights_only=True)
    torch.save(old | {"optimizer_states": old["optimizer_states"] * 6}, path)
    make_trainer(3).validate(_module(), data, ckpt_path=path, weights_only=False, verbose=False)
    with value_error(r"is from an earlier version.*start a new run, from its splat"):
        make_trainer(3).fit(_module(), data, ckpt_path=path, weights_only=False)


class _Heard(lightning.Callback):
    """What the hooks of a callback are told."""

    def __init__(self):
        self.ends, self.validations, self.inner = [], [], []

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        self.ends.append((trainer.global_step, batch_idx, batch["name"]))

    def on_validation_start(self, trainer, module):
        self.validations.append(trainer.global_step)

    def on_before_backward(self, *_):
        self.inner.append("before backward")

    def on_after_backward(self, *_):
        self.inner.append("after backward")

    def on_before_optimizer_step(self, *_):
        self.inner.append("before step")


def test_lightning_counts_images(data, make_trainer, tmp_path):
    heard = _Heard()
    on = {"enable_checkpointing": True, "limit_val_batches": 1.0, "val_check_interval": 12, "num_sanity_val_steps": 0}
    trainer = make_trainer(33, callbacks=[heard, _checkpoints(tmp_path, every=15)], **on)
    trainer.fit(_module(panels=0), data)
    assert trainer.global_step == 33
    assert [end[:2] for end in heard.ends] == [(step, step - 1) for step in range(1, 34)]
    assert heard.inner == ["before backward", "after backward", "before step"] * 33
    assert heard.validations == [12, 24]
    assert sorted(path.name for path in tmp_path.glob("*.ckpt")) == ["step=15.ckpt", "step=30.ckpt"]
    again = _Heard()
    trainer = make_trainer(33, callbacks=[again], **(on | {"enable_checkpointing": False}))
    trainer.fit(_module(panels=0), data, ckpt_path=tmp_path / "step=15.ckpt", weights_only=False)
    assert again.ends == heard.ends[15:]
    assert again.validations == [24]


def test_data_that_end(data, make_trainer):
    data.train_dataloader = lambda: torch.utils.data.DataLoader(data.train, batch_size=None)
    for options, epoch in (({}, 6), ({"limit_train_batches": 4}, 4)):
        heard = _Heard()
        trainer = make_trainer(14, callbacks=[heard], **options)
        trainer.fit(_module(), data)
        assert [end[0] for end in heard.ends] == list(range(1, 15))
        assert [end[2] for end in heard.ends] == [f"{index % epoch:03d}" for index in range(14)]


class _StopAt(lightning.Callback):
    """Ends a training early, its schedule unchanged."""

    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        trainer.should_stop = trainer.should_stop or trainer.global_step >= self.step


def test_a_checkpoint_is_evaluated_as_it_was_in_training(data, make_trainer, tmp_path):
    path, on = tmp_path / "step=10.ckpt", {"limit_val_batches": 1.0, "val_check_interval": 10}
    options = {"sh_every": 6, "panels": 1}
    module = _module(**options)
    trainer = make_trainer(10, "first", enable_checkpointing=True, callbacks=[_checkpoints(tmp_path)], **on)
    trainer.fit(module, data)
    trained = trainer.callback_metrics["val/psnr"]
    loaded = SplatTrainer.load_from_checkpoint(path, sh_degree=1, weights_only=False)
    assert torch.equal(loaded.splat.means, module.splat.means)
    again = _module(**options)
    given = {"ckpt_path": path, "weights_only": False, "verbose": False}
    (found,) = make_trainer(10, **on).validate(again, data, **given)
    assert found["val/psnr"] == pytest.approx(float(trained), abs=1e-5)
    assert again.active_degree(9) == 1
    assert [path.name for path in (tmp_path / "run" / "panels").glob("*.png")] == ["val_00_000010.png"]
    (tested,) = make_trainer(1).test(_module(**options), data, **given)
    assert tested == make_trainer(1).test(module, data, verbose=False)[0]
    assert tested["test/gaussians"] == len(module.splat)
    with value_error("`sh_degree` 1, but the configuration says 2"):
        SplatTrainer.load_from_checkpoint(path, sh_degree=2, weights_only=False)


class Breaks(LossTerm):
    """Zero, and not a number from a step on."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def forward(self, inputs):
        return inputs.means.sum() * (math.nan if inputs.step >= self.at else 0.0)


def test_a_loss_that_is_not_finite_stops(data, make_trainer, tmp_path):
    module = _module(loss_terms={"breaks": Breaks(7)})
    trainer = make_trainer(20, enable_checkpointing=True, callbacks=[_checkpoints(tmp_path, every=3)])
    with pytest.raises(TrainingDiverged, match=r"step 7: the loss is not finite.*step=6\.ckpt") as caught:
        trainer.fit(module, data)
    assert caught.value.step == 7
    assert sorted(path.name for path in tmp_path.glob("*.ckpt")) == ["step=3.ckpt", "step=6.ckpt"]
    state = torch.load(caught.value.checkpoint, weights_only=False)["state_dict"]
    assert all(torch.isfinite(value).all() for value in state.values())


def test_a_view_without_gaussians(data, make_trainer):
    module = _module()
    cloud = gaussians_from_points(torch.rand(20, 3), torch.rand(20, 3), 1)
    cloud.means.sub_(torch.tensor([0.0, 100.0, 0.0]))  # behind the cameras
    data.initial_cloud = lambda degree: cloud
    make_trainer(5).fit(module, data)
    assert torch.isfinite(module.splat.means).all()


def test_gaussians_that_are_not_finite_are_not_kept(data, make_trainer, tmp_path):
    class Spoils(lightning.Callback):
        def on_train_batch_start(self, trainer, module, *_):
            if trainer.global_step == 4:
                module.splat.quats.data[3] = math.nan

    only_rgb = {"anisotropy": 0, "entropy": 0, "size": 0}
    module = _module(loss_weights=only_rgb, densification=DefaultDensification(stop=0))
    callbacks = [Spoils(), _checkpoints(tmp_path, every=3)]
    with pytest.raises(TrainingDiverged, match=r"step 6: a value of `.*step=3\.ckpt"):
        make_trainer(20, enable_checkpointing=True, callbacks=callbacks).fit(module, data)
    assert [path.name for path in tmp_path.glob("*.ckpt")] == ["step=3.ckpt"]
    module.export(tmp_path / "some.ply")
    assert len(read_ply(tmp_path / "some.ply")) == data.points - 1


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["default", "mcmc"])
def test_a_training_on_a_gpu(kind, data, make_trainer, tmp_path):
    if kind == "mcmc":
        terms = {"opacity": MeanOpacityLoss(), "scale": MeanScaleLoss()}
        options = {"loss_terms": terms, "loss_weights": {"opacity": 0.01, "scale": 0.01}}
        options["densification"] = MCMCDensification(cap=200, start=20, every=20)
    else:
        chosen = DefaultDensification(start=20, every=40, grow_grad2d=5e-4)
        options = {"densification": chosen}
    module = _module(sh_every=50, **options)
    callbacks = [_checkpoints(tmp_path, every=100)]
    on_gpu = {"accelerator": "gpu", "devices": 1, "limit_val_batches": 1.0, "val_check_interval": 1000}
    trainer = make_trainer(200, enable_checkpointing=True, callbacks=callbacks, **on_gpu)
    start, end = _learned(trainer, module, data)
    assert end["val/psnr"] > start["val/psnr"] + 3.0
    assert len(module.splat) != data.points
    module.cpu().render(data.held_out[0]["camera"])
    again = _module(sh_every=50, **options)
    path = tmp_path / "step=100.ckpt"
    make_trainer(200, **on_gpu).fit(again, data, ckpt_path=path, weights_only=False)
    assert again.trainer.global_step == 200


def test_what_cannot_be_trained_is_refused(data, make_trainer):
    with value_error(r"`trainer\.precision` to be 32-true"):
        make_trainer(3, precision="bf16-mixed").fit(_module(), data)
    chosen = DefaultDensification(start=1, every=2, prune_opacity=0.49)
    with value_error(r"No Gaussian is left at step \d+: lower `densification\.prune_opacity`"):
        make_trainer(20).fit(_module(densification=chosen), data)


class _Board(lightning.pytorch.loggers.logger.DummyLogger):
    """A logger whose experiment takes pictures."""

    def __init__(self):
        super().__init__()
        self.pictures = {}

    @property
    def experiment(self):
        return self

    def add_image(self, name, pixels, step, dataformats):
        self.pictures[name] = (pixels.shape, step, dataformats)


def test_what_is_shown_on_the_way(data, make_trainer):
    board = _Board()
    trainer = make_trainer(4, logger=board, limit_val_batches=1.0, val_check_interval=4)
    trainer.fit(_module(panels=1), data)
    assert board.pictures == {"val_00": ((32, 4 * 48, 3), 4, "HWC")}
    assert trainer.progress_bar_metrics["gaussians"] == 150
    assert trainer.progress_bar_metrics["psnr"] > 5


def test_schedules(data, make_trainer):
    rates = LearningRates()
    assert means_rate(rates, 2.0, 0, 100) == pytest.approx(3.2e-4)
    assert means_rate(rates, 2.0, 50, 100) == pytest.approx(3.2e-5)
    assert means_rate(rates, 2.0, 100, 100) == pytest.approx(3.2e-6)
    module = SplatTrainer(sh_degree=2, sh_every=10)
    assert [module.active_degree(step) for step in (0, 9, 10, 25, 99)] == [0, 0, 1, 2, 2]
    assert SplatTrainer(sh_degree=2, sh_every=0).active_degree(0) == 2
    module = _module(densification=DefaultDensification(stop=0))
    make_trainer(3).fit(module, data)
    got = [group["lr"] for optimizer in module.trainer.optimizers for group in optimizer.param_groups]
    assert got == pytest.approx([means_rate(rates, 1.5, 2, 3), 5e-3, 1e-3, 5e-2, 2.5e-3, 2.5e-3 / 20])
    assert all(parameter.grad is None for parameter in module.splat.parameters())
    # harmonics that are not in use do not move
    assert peak(module.splat.shN) == 0


def test_backgrounds(data):
    module = _module(background=[1.0, 0.5, 0.0])
    image = torch.full((2, 2, 3), 0.25)
    alpha = torch.tensor([[1.0, 0.0], [0.5, 0.0]])[..., None]
    target, shape, _ = module._target({"image": image, "alpha": alpha}, train=True)
    assert shape.shape == (2, 2, 1)
    assert_close(target[0, 1], torch.tensor([1.0, 0.5, 0.0]))
    assert_close(target[1, 0], torch.tensor([0.625, 0.375, 0.125]))
    assert module._target({"image": image, "alpha": None}, train=True)[0] is image
    assert _module(background="white")._target({"image": image, "alpha": alpha}, train=False)[2].eq(1).all()
    with value_error("`background` to be a colour from 0 to 1"):
        _module(background=[255.0, 255.0, 255.0])
    module = _module()
    one, two = (module._target({"image": image, "alpha": alpha}, train=True)[2] for _ in range(2))
    assert not torch.equal(one, two)
    assert module._target({"image": image, "alpha": alpha}, train=False)[2].eq(0).all()


def test_gaussians_from_a_file(data, make_trainer, tmp_path):
    make_trainer(1).fit(_module(densification=DefaultDensification(stop=0)), data)
    for degree in (0, 2):
        module = _module(init_ply=str(tmp_path / "run/point_cloud.ply"), sh_degree=degree)
        make_trainer(1, folder="other").fit(module, data)
        assert module.splat.sh.shape[1] == (degree + 1) ** 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sh_degree": 4}, "`sh_degree`"),
        ({"background": [1.0]}, "`background` to have 3 numbers"),
        ({"scene_scale": 0.0}, "`scene_scale`"),
        ({"log_every": 0}, "`log_every`"),
    ],
)
def test_bad_settings(options, words):
    with value_error(words):
        SplatTrainer(**options)
