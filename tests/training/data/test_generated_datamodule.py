import json
import shutil

import pytest
import torch
from shared import value_error

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.training.data.generated_datamodule import GeneratedDataModule


def _data(path, **options):
    return GeneratedDataModule(
        path, GeneratedCapture(**({"views": 8, "size": 16} | options)), workers=1, point_count=50
    )


def test_images_are_drawn_once(tmp_path):
    data = _data(tmp_path / "a/flag")
    data.setup("fit")
    assert len(data.capture.split("train")) == 7
    assert len(data.capture.split("test")) == 1
    assert data.scene_scale > 1.0
    cloud = data.initial_cloud(1)
    assert cloud.sh.shape == (50, 4, 3)
    batch = next(iter(data.train_dataloader()))
    assert batch["image"].shape == (16, 16, 3)
    assert torch.is_tensor(batch["alpha"])
    file = tmp_path / "a/flag/transforms.json"
    changed = file.stat().st_mtime_ns
    _data(tmp_path / "a/flag").setup("test")
    assert file.stat().st_mtime_ns == changed
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["flag"]


def test_other_things_are_left_alone(tmp_path):
    _data(tmp_path / "flag").setup("test")
    with value_error("made with another ripple: remove it or set `path`"):
        _data(tmp_path / "flag", ripple=0.1).setup("fit")
    (tmp_path / "mine").mkdir()
    with value_error("is not a generated capture"):
        _data(tmp_path / "mine").setup("fit")


def test_of_two_runs_at_once_the_faster_one_draws(tmp_path, monkeypatch):
    flag = GeneratedCapture(views=9, size=16)
    data = GeneratedDataModule(tmp_path / "flag", flag, workers=1)
    draw = GeneratedCapture.write
    rival = {"size": 16}

    def slow(self, folder, threads=2):
        if not (tmp_path / "flag").exists():
            (tmp_path / "flag").mkdir()
            held = {name: value for name, value in vars(self).items() if not name.startswith("_")} | rival
            (tmp_path / "flag" / "generated.json").write_text(json.dumps(held))
        return draw(self, folder, threads)

    monkeypatch.setattr(GeneratedCapture, "write", slow)
    data._make()
    shutil.rmtree(tmp_path / "flag")
    rival["size"] = 99
    with pytest.raises(OSError, match="not empty"):
        data._make()
