"""tools/train.py: the shipped configurations, a whole run on a CPU, and bad input."""

import os
import shlex
import shutil
import signal
import sys
from pathlib import Path
from pickle import UnpicklingError

import pytest
import torch
import yaml
from damage import Fuse
from shared import contents, rows, words

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.cli.train import main, make_cli
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.runs.lock import FolderLock
from gaussian_swaying.runs.signals import StoppedBySignal
from gaussian_swaying.training.module import SplatTrainer, TrainingDiverged

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args", "ignore:skip_none", "ignore:.*LeafSpec")
ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "configs/train").glob("*.yaml"))
QUICK = ROOT / "configs/train/quick_cpu.yaml"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return GeneratedCapture(views=10, size=40).write(tmp_path_factory.mktemp("data") / "flag", threads=1)


def _arguments(capture, folder, **options):
    data = {"path": str(capture), "point_count": 600, "workers": 1}
    options = {
        "data": {"class_path": "CaptureDataModule", "init_args": data},
        "trainer.default_root_dir": str(folder),
        "trainer.max_steps": 20,
        "trainer.val_check_interval": 1000,
        "trainer.enable_progress_bar": False,
        "model.densification.init_args.start": 2,
        "model.densification.init_args.every": 5,
        "checkpoint.every_n_train_steps": 10,
        "checkpoint.save_top_k": -1,
    } | options
    return ["--config", str(QUICK), *words(options)]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.name)
def test_every_shipped_configuration_builds(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = yaml.safe_load(config.read_text())
    files = [config] if "class_path" in text.get("data", {}) else [CONFIGS_DEFAULT, config]
    arguments = [part for file in files for part in ("--config", str(file))]
    cli = make_cli([*arguments, "--trainer.accelerator", "cpu", "--trainer.logger", "false"], run=False)
    assert cli.trainer.max_steps == text.get("trainer", {}).get("max_steps", 60_000)
    paper = {"rgb": 1.0, "anisotropy": 10.0, "entropy": 0.01, "size": 0.01}
    assert cli.model.loss.weights == text.get("model", {}).get("loss_weights", paper)
    assert cli.trainer.checkpoint_callback is not None
    assert list(tmp_path.iterdir()) == []


CONFIGS_DEFAULT = ROOT / "configs/train/default.yaml"


def test_the_recipe_for_photos_runs_on_a_capture(capture, tmp_path, capsys):
    given = {"data.init_args.path": str(capture), "data.init_args.downscale": 2, "data.init_args.point_count": 200}
    given |= {"trainer.max_steps": 4, "trainer.val_check_interval": 4, "trainer.enable_progress_bar": False}
    assert main(["fit", "--config=photos_cpu", *words(given | {"trainer.default_root_dir": str(tmp_path)})]) == 0
    told = capsys.readouterr()
    assert "next: " in told.out
    assert "logs" not in told.err  # Lightning warns of a folder of logs that is not empty
    assert len(read_ply(tmp_path / "point_cloud.ply")) == 200
    assert (tmp_path / "panels" / "val_00_000004.png").exists()


def test_a_second_run_in_the_same_folder_keeps_its_own_last_state(capture, tmp_path):
    """Of 13 images, with a checkpoint every 10."""
    options = {"trainer.max_steps": 13, "checkpoint.save_top_k": 1}
    for count in (600, 500):
        more = {"data.init_args.point_count": count, "model.densification.init_args.start": 99}
        assert main(["fit", *_arguments(capture, tmp_path / "run", **options, **more)]) == 0
    last = torch.load(tmp_path / "run/checkpoints/step_000013.ckpt", weights_only=True)
    assert last["global_step"] == 13
    assert len(last["state_dict"]["model.means"]) == 500


def _rows(folder, version="."):
    return rows(folder / "csv" / version / "metrics.csv")


@pytest.fixture
def _interrupts():
    """Lightning ignores Ctrl-C once it has heard it, to the end of the process."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def _stop_at(monkeypatch, step, error):
    train = SplatTrainer.training_step

    def stop(self, batch):
        if self.global_step == step:
            raise error
        return train(self, batch)

    monkeypatch.setattr(SplatTrainer, "training_step", stop)


@pytest.mark.slow(gate=["divergence", "SIGTERM"])
@pytest.mark.usefixtures("_interrupts")
@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (KeyboardInterrupt(), 130, "Stopped."),
        (StoppedBySignal(15), 143, "Stopped."),
        (ValueError("a broken image"), 2, "error: a broken image"),
        (TrainingDiverged(12, "the loss", None), 2, "error: Training diverged"),
    ],
    ids=["Ctrl-C", "SIGTERM", "failure", "divergence"],
)
def test_a_training_that_ends_early_names_its_checkpoint(error, code, told, capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tools/train.py"])
    monkeypatch.chdir(tmp_path)
    folder, steps = Path("run"), {"trainer.max_steps": 16, "model.log_every": 4}
    with monkeypatch.context() as patch:
        _stop_at(patch, 12, error)
        assert main(["fit", *_arguments(capture, folder, **steps)]) == code
    said = capsys.readouterr().err
    path = "run/checkpoints/step_000010.ckpt"
    assert told in said
    assert f"{path} is the last checkpoint; to continue:\n  python tools/train.py fit --config" in said
    assert said.endswith(f" --ckpt_path {path}\n")
    assert [row["step"] for row in _rows(folder)] == ["1", "5", "9"]
    assert not [path for path in folder.rglob(".*")]
    again = shlex.split(said.splitlines()[-1])[2:]
    assert main(again) == 0
    assert [row["step"] for row in _rows(folder, "version_0") if row["train/loss"]] == ["13", "16"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_refused_training_changes_nothing(capture, tmp_path, capsys):
    """Whatever it is refused for: data, checkpoint, the training itself, or another one that is running."""
    folder = tmp_path / "run"
    few = {"trainer.max_steps": 3, "checkpoint.every_n_train_steps": 2}
    assert main(["fit", *_arguments(capture, folder, **few)]) == 0
    assert not [path for path in folder.rglob(".*")]
    before = contents(tmp_path)
    assert {"metrics.csv", "config.yaml", "point_cloud.ply", "step_000003.ckpt"} <= {path.name for path in before}
    broken = tmp_path / "broken.ckpt"
    shutil.copytree(capture, tmp_path / "cut")
    for image in (tmp_path / "cut" / "images").iterdir():
        image.write_bytes(image.read_bytes()[:60])
    last = folder / "checkpoints/step_000003.ckpt"
    broken.write_bytes(last.read_bytes()[:999])
    before = contents(tmp_path)
    for options, told in (
        ({"data.init_args.path": "nowhere"}, "nowhere does not exist"),
        ({"data.init_args.path": str(tmp_path / "cut")}, ""),
        ({"ckpt_path": str(broken)}, "cannot be read as a checkpoint"),
        ({"ckpt_path": str(last)}, "has already trained on 3 images, and `trainer.max_steps` is 3"),
        ({"trainer.precision": "16-mixed"}, "precision"),
    ):
        assert main(["fit", *_arguments(capture, folder, **few), *words(options)]) == 2
        said = capsys.readouterr().err
        assert told in said, said
        assert "error: " in said
        assert "to continue" not in said
        assert contents(tmp_path) == before, options
    lock = FolderLock(folder)
    assert main(["fit", *_arguments(capture, folder, **few)]) == 2
    assert f"process {os.getpid()} on this host" in capsys.readouterr().err
    lock.release()
    assert contents(tmp_path) == before
    # looking at it makes a log of its own
    capsys.readouterr()
    assert main(["validate", *_arguments(capture, folder), f"--ckpt_path={last}"]) == 0
    assert f"wrote {folder}/csv\n" in capsys.readouterr().out
    assert {path: content for path, content in contents(tmp_path).items() if path in before} == before
    assert float(_rows(folder, "version_0")[-1]["val/psnr"]) > 0


def test_a_second_training_moves_the_first_aside(capture, tmp_path, capsys):
    folder, steps = tmp_path / "run", {"trainer.max_steps": 2}
    assert main(["fit", *_arguments(capture, folder, **steps)]) == 0
    first = contents(folder)
    assert main(["fit", *_arguments(capture, folder, **steps)]) == 0
    assert f"An earlier run in {folder} was moved to {tmp_path / 'run.1'}." in capsys.readouterr().out
    assert {path.name: content for path, content in first.items()} == {
        path.name: content for path, content in contents(tmp_path / "run.1").items()
    }
    # its checkpoint from elsewhere is read, and it stays where it is
    old = tmp_path / "run.1/checkpoints/step_000002.ckpt"
    more = {"trainer.max_steps": 3, "ckpt_path": str(old), "model.init_ply": str(tmp_path / "run/point_cloud.ply")}
    assert main(["fit", *_arguments(capture, folder, **more)]) == 2
    assert "point_cloud.ply is in it and is needed now: choose another with --trainer.default_root_dir" in (
        capsys.readouterr().err
    )
    del more["model.init_ply"]
    assert main(["fit", *_arguments(capture, folder, **more)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run", "run.1", "run.2"}
    assert old.exists()


OWN = """
import torch
from gaussian_swaying.training.losses import LossTerm

class Flatness(LossTerm):
    def __init__(self, share: float = 0.5) -> None:
        super().__init__()
        self.share = share

    def forward(self, inputs):
        return self.share * inputs.log_scales.amin(-1).exp().mean()
"""


def test_a_loss_of_ones_own_from_a_yaml(capture, tmp_path, monkeypatch):
    (tmp_path / "my_losses.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    term = {"flat": {"class_path": "my_losses.Flatness", "init_args": {"share": 0.25}}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"model": {"loss_terms": term}}))
    arguments = ["--config", str(QUICK), "--config", str(tmp_path / "own.yaml"), "--model.loss_weights.flat=3"]
    arguments += ["--model.loss_weights.anisotropy=0", "--trainer.logger=false"]
    loss = make_cli([*arguments, f"--trainer.default_root_dir={tmp_path}"], run=False).model.loss
    assert loss.weights == {"rgb": 1.0, "anisotropy": 0.0, "entropy": 0.01, "size": 0.01, "flat": 3.0}
    assert loss.terms["flat"].share == 0.25
    assert set(loss.terms) == {"rgb", "entropy", "size", "flat"}


@pytest.mark.parametrize("command", ["fit", "validate", "test"])
def test_a_checkpoint_executes_no_code(command, capture, tmp_path, capsys):
    """Neither in the check before nor by Lightning, which is asked alone too."""
    file, burnt = tmp_path / "evil.ckpt", tmp_path / "burnt"
    torch.save({"splat_training": {}, "state_dict": {}, "fuse": Fuse(burnt)}, file)
    assert main([command, *_arguments(capture, tmp_path / "run"), f"--ckpt_path={file}"]) == 2
    assert "more than tensors, numbers and text" in capsys.readouterr().err
    cli = make_cli(_arguments(capture, tmp_path / "run"), run=False)
    with pytest.raises(UnpicklingError, match="Weights only load failed"):
        getattr(cli.trainer, command)(cli.model, datamodule=cli.datamodule, ckpt_path=file)
    assert not burnt.exists()
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"trainer.gradient_clip_val": 1}, ["gradient"]),
        ({"ckpt_path": "README.ckpt"}, ["README.ckpt"]),
        ({"ckpt_path": str(QUICK)}, ["quick_cpu.yaml cannot be read as a checkpoint", "`--ckpt_path`"]),
        ({"model.loss_weights.siz": 1.0}, ["`loss_weights`", "siz"]),
        ({"model.densification.init_args.every": 0}, ["`densification.every`"]),
        ({"model.bogus": 1}, ["bogus"]),
        ({"model.seed": "many"}, ["model.seed", "many"]),
        ({"model.densification": "MCMCDensification"}, ["MCMCDensification needs CUDA"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_settings(options, told, capture, tmp_path, capsys):
    arguments = _arguments(capture, tmp_path)
    if "model.densification" in options:
        arguments = [part for part in arguments if "densification" not in part]
    assert main(["fit", *arguments, *words(options)]) == 2
    error = capsys.readouterr().err.split("error: ")[-1]
    for word in told:
        assert word in error, error
    assert error.count("\n") == 1
