"""Several images in one step of Lightning: the same training, and Lightning counts images."""

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from gaussian_swaying.training.densification import PARAMETERS, DefaultDensification
from gaussian_swaying.training.module import SplatTrainer


def _module(every, **options):
    densification = DefaultDensification(start=1, every=4, grow_grad2d=1e-4)
    return SplatTrainer(sh_degree=1, sh_every=7, densification=densification, lpips=None, hooks_every=every, **options)


class _Heard(lightning.Callback):
    """What the hooks of a callback are told."""

    def __init__(self):
        self.ends, self.validations = [], []

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        self.ends.append((trainer.global_step, batch_idx))

    def on_validation_start(self, trainer, module):
        self.validations.append(trainer.global_step)


def _state(module):
    found = {name: getattr(module.splat, name).detach() for name in PARAMETERS}
    for optimizer in module.trainer.optimizers:
        for values in optimizer.state.values():
            found |= {f"{len(found)} {key}": value for key, value in values.items()}
    return found


def test_the_result_does_not_depend_on_when_hooks_are_called(data, make_trainer):
    states = []
    for every in (1, 7, 100):
        module = _module(every)
        make_trainer(20).fit(module, data)
        states.append(_state(module))
    for other in states[1:]:
        assert other.keys() == states[0].keys()
        assert all(torch.equal(value, other[name]) for name, value in states[0].items())


def test_lightning_counts_images(data, make_trainer, tmp_path):
    """Hooks come at multiples, and where a checkpoint, a validation or the end is due, with the image's number."""
    heard = _Heard()
    kept = ModelCheckpoint(dirpath=tmp_path, every_n_train_steps=15, save_top_k=-1, filename="{step}")
    on = {"enable_checkpointing": True, "limit_val_batches": 1.0, "val_check_interval": 12}
    trainer = make_trainer(33, callbacks=[heard, kept], num_sanity_val_steps=0, **on)
    trainer.fit(_module(10, panels=0), data)
    assert [step for step, _ in heard.ends] == [10, 12, 15, 20, 24, 30, 33]
    assert all(number == step - 1 for step, number in heard.ends)
    assert heard.validations == [12, 24]
    assert sorted(path.name for path in tmp_path.glob("*.ckpt")) == ["step=15.ckpt", "step=30.ckpt"]
    counted = trainer.fit_loop.epoch_loop.batch_progress.total
    assert (counted.ready, counted.started, counted.processed, counted.completed) == (33,) * 4
    heard = _Heard()
    trainer = make_trainer(33, callbacks=[heard], num_sanity_val_steps=0, **(on | {"enable_checkpointing": False}))
    trainer.fit(_module(20, panels=0), data, ckpt_path=tmp_path / "step=15.ckpt", weights_only=False)
    assert heard.ends == [(20, 19), (24, 23), (33, 32)]
    assert heard.validations == [24]


def test_an_epoch_ends_where_the_trainer_says(data, make_trainer):
    heard = _Heard()
    trainer = make_trainer(25, callbacks=[heard], limit_train_batches=8)
    trainer.fit(_module(10), data)
    assert [step for step, _ in heard.ends] == [8, 10, 16, 20, 24, 25]


def test_data_that_end(data, make_trainer):
    """A loader of six views: an epoch of six images."""
    data.train_dataloader = lambda: torch.utils.data.DataLoader(data.train, batch_size=None)
    heard = _Heard()
    trainer = make_trainer(14, callbacks=[heard])
    trainer.fit(_module(10), data)
    assert trainer.global_step == 14
    assert [step for step, _ in heard.ends] == [6, 10, 12, 14]


@pytest.mark.parametrize("hook", ["on_before_backward", "on_after_backward", "on_before_optimizer_step"])
def test_hooks_within_a_step_come_with_every_image(hook, data, make_trainer):
    calls = []
    callback = type("Inner", (lightning.Callback,), {hook: lambda self, *_: calls.append(1)})()
    trainer = make_trainer(12, callbacks=[callback])
    trainer.fit(_module(10), data)
    assert len(calls) == 12
    assert trainer.global_step == 12


def test_hooks_every_is_checked():
    with pytest.raises(ValueError, match="`hooks_every`"):
        SplatTrainer(hooks_every=0)
