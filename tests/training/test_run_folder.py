"""Which folders a training takes, and when."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from shared import value_error

from gaussian_swaying.runs.folder import MARKER
from gaussian_swaying.runs.lock import FolderLocked
from gaussian_swaying.training.run_folder import RunFolder


def _begin(root, output=None, ckpt=None, data=None):
    taken = RunFolder()
    taken.root = root
    trainer = SimpleNamespace(ckpt_path=ckpt, datamodule=SimpleNamespace(path=data), log_dir=str(root / "csv"))
    trainer.world_size, trainer.is_global_zero = 1, True
    trainer.state, trainer.sanity_checking = SimpleNamespace(fn="fit"), False
    module = SimpleNamespace(folder=root if output is None else output, init_ply=None, last_checkpoint=lambda: None)
    module.trainer = trainer
    taken.on_validation_start(trainer, module)
    taken.on_train_batch_start(trainer, module, None, 0)
    assert taken.begun
    return taken


@pytest.mark.parametrize("output", ["elsewhere", "run/inside", ".."])
def test_results_apart_from_the_folder(output, tmp_path):
    """Both are held; one within the other needs no lock of its own."""
    base = tmp_path / "base"
    root, results = base / "run", (base / output)
    results = base if output == ".." else results
    first = _begin(root, results)
    for folder in (root, results):
        if output == "elsewhere" or folder == min(root, results):
            with pytest.raises(FolderLocked):
                _begin(folder)
    first.release()
    if output == "elsewhere":
        assert (root / MARKER).exists()
        assert (results / MARKER).exists()
        (results / "point_cloud.ply").write_text("precious")
        _begin(tmp_path / "other", results).release()
        assert (base / "elsewhere.1" / "point_cloud.ply").read_text() == "precious"


def test_a_folder_that_holds_the_photos(tmp_path, capsys):
    """The first training may be written beside them; a second one must not move them away."""
    (tmp_path / "images").mkdir()
    _begin(tmp_path, data=tmp_path / "images").release()
    with value_error(r"images is in it and is needed now: choose another with --trainer.default"):
        _begin(tmp_path, data=tmp_path / "images")
    assert not (tmp_path / ".gaussian_swaying.lock").exists()
    _begin(tmp_path, ckpt=tmp_path / "checkpoints/step_000010.ckpt", data=tmp_path / "images").release()
    assert Path(f"{tmp_path}.1").exists() is False
