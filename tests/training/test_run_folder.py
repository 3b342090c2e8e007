from pathlib import Path
from types import SimpleNamespace

from shared import value_error

from gaussian_swaying.training.run_folder import RunFolder


def _begin(root, ckpt=None, data=None):
    taken = RunFolder()
    trainer = SimpleNamespace(ckpt_path=ckpt, datamodule=SimpleNamespace(path=data), log_dir=str(root / "csv"))
    trainer.is_global_zero, trainer.default_root_dir = True, str(root)
    trainer.strategy = SimpleNamespace(barrier=lambda: None)
    taken.on_train_start(trainer, SimpleNamespace(init_ply=None, last_checkpoint=lambda: None))
    assert taken.begun
    return taken


def test_a_folder_that_holds_the_photos(tmp_path, capsys):
    """The first training may be written beside them; a second one must not move them away."""
    (tmp_path / "images").mkdir()
    _begin(tmp_path, data=tmp_path / "images").teardown(None, None, "fit")
    with value_error(r"images is in it and is needed now: choose another with --trainer.default"):
        _begin(tmp_path, data=tmp_path / "images")
    assert not (tmp_path / ".gaussian_swaying.lock").exists()
    _begin(tmp_path, tmp_path / "checkpoints/step_000010.ckpt", tmp_path / "images").teardown(None, None, "fit")
    assert Path(f"{tmp_path}.1").exists() is False
