"""tools/train.py: the shipped configurations, a whole run on a CPU, and bad input."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from gaussian_swaying.cli.errors import parser_sentence
from gaussian_swaying.data.generated_capture import GeneratedCapture
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.simulation.config import main as simulate
from gaussian_swaying.training.cli import main, make_cli
from gaussian_swaying.training.densification import PARAMETERS

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args", "ignore:skip_none", "ignore:.*LeafSpec")
ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "configs/train").glob("*.yaml"))
QUICK = ROOT / "configs/train/quick_cpu.yaml"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A generated flag as a folder of images."""
    return GeneratedCapture(views=10, size=40).write(tmp_path_factory.mktemp("data") / "flag", threads=1)


def _arguments(capture, folder, **options):
    data = {"class_path": "CaptureDataModule", "init_args": {"path": str(capture), "point_count": 600, "workers": 1}}
    options = {
        "data": json.dumps(data),
        "trainer.default_root_dir": str(folder),
        "trainer.max_steps": 20,
        "trainer.val_check_interval": 1000,
        "trainer.enable_progress_bar": "false",
        "model.densification.init_args.start": 2,
        "model.densification.init_args.every": 5,
        "checkpoint.every_n_train_steps": 10,
        "checkpoint.save_top_k": -1,
    } | options
    return ["--config", str(QUICK)] + [f"--{name}={value}" for name, value in options.items()]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.name)
def test_every_shipped_configuration_builds(config, tmp_path, monkeypatch):
    """Parsed, and model, data and trainer made; an overlay goes on top of the default."""
    monkeypatch.chdir(tmp_path)
    text = yaml.safe_load(config.read_text())
    files = [config] if "class_path" in text.get("data", {}) else [CONFIGS_DEFAULT, config]
    arguments = [part for file in files for part in ("--config", str(file))]
    cli = make_cli([*arguments, "--trainer.accelerator", "cpu", "--trainer.logger", "false"], run=False)
    assert cli.trainer.max_steps == text.get("trainer", {}).get("max_steps", 60_000)
    paper = {"rgb": 1.0, "anisotropy": 10.0, "entropy": 0.01, "size": 0.01}
    assert cli.model.loss.weights == (text["model"]["loss_weights"] if config.stem == "mcmc" else paper)
    assert cli.trainer.checkpoint_callback.dirpath.endswith("checkpoints")
    assert list(tmp_path.iterdir()) == []


CONFIGS_DEFAULT = ROOT / "configs/train/default.yaml"


def test_there_are_configurations():
    assert {path.stem for path in CONFIGS} >= {"default", "7k", "flag", "fox", "quick_cpu"}
    assert yaml.safe_load(CONFIGS_DEFAULT.read_text())["trainer"]["max_steps"] == 60_000


def test_the_quick_training(tmp_path, monkeypatch, capsys):
    """200 images of a generated flag on a CPU: 6 dB and more, and a splat that the simulation takes as it is."""
    monkeypatch.chdir(tmp_path)
    quiet = ["--trainer.enable_progress_bar", "false"]
    monkeypatch.setenv("GAUSSIAN_SWAYING_DEBUG", "1")
    start = make_cli(["validate", "--config", str(QUICK), *quiet]).trainer.callback_metrics
    assert main(["fit", "--config", str(QUICK), *quiet]) == 0
    printed = capsys.readouterr().out
    assert "wrote outputs/train/quick_cpu/point_cloud.ply" in printed
    assert "wrote outputs/train/quick_cpu/csv" in printed
    folder = tmp_path / "outputs/train/quick_cpu"
    with (folder / "csv/metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    end = [float(row["val/psnr"]) for row in rows if row["val/psnr"]]
    assert len(end) == 2
    assert end[-1] >= float(start["val/psnr"]) + 6.0
    assert sum(bool(row["train/loss"]) for row in rows) == 11
    assert (folder / "panels/val_00_000200.png").stat().st_size > 0
    cloud = read_ply(folder / "point_cloud.ply")
    assert int(float(rows[-1]["val/gaussians"])) == len(cloud)
    arguments = [
        "--config",
        str(ROOT / "configs/sim/hanging_object.yaml"),
        "--scene.ply",
        str(folder / "point_cloud.ply"),
    ]
    arguments += ["--frames", "2", "--device", "cpu", "--recorder.video", "false", "--scene.up", "[0, 0, 1]"]
    region = {"class_path": "Box", "init_args": {"min": [None, None, 0.4], "max": [None, None, None]}}
    pin = [{"class_path": "PinnedRegion", "init_args": {"region": region}}]
    arguments += ["--solver.boundaries", json.dumps(pin), "--camera.init_args.width", "64", "--solver.dx", "0.1"]
    assert simulate([*arguments, "--camera.init_args.height", "36", "--output", str(tmp_path / "sim")]) == 0
    assert json.loads((tmp_path / "sim/summary.json").read_text())["frames"] == 2


def test_a_resumed_run_is_the_same_bit_for_bit(capture, tmp_path):
    """Through files, validation and data of a folder: 20 images, or the second 10 from the checkpoint between."""
    straight = make_cli(["fit", *_arguments(capture, tmp_path / "a", **{"trainer.val_check_interval": 6})]).model
    path = tmp_path / "a/checkpoints/step_000010.ckpt"
    resumed = make_cli(["fit", *_arguments(capture, tmp_path / "b", **{"ckpt_path": path})])
    assert resumed.trainer.global_step == 20
    assert len(resumed.model.splat) != 600
    for name in PARAMETERS:
        assert torch.equal(getattr(resumed.model.splat, name), getattr(straight.splat, name)), name


def test_the_last_image_is_in_a_checkpoint(capture, tmp_path):
    """13 images with a checkpoint every 10."""
    main(["fit", *_arguments(capture, tmp_path, **{"trainer.max_steps": 13, "checkpoint.save_top_k": 1})])
    names = sorted(path.name for path in (tmp_path / "checkpoints").glob("*.ckpt"))
    assert "step_000013.ckpt" in names
    state = torch.load(tmp_path / "checkpoints/step_000013.ckpt", weights_only=False)
    assert state["global_step"] == 13


def test_a_second_run_in_the_same_folder_keeps_its_own_last_state(capture, tmp_path):
    options = {"trainer.max_steps": 13, "checkpoint.save_top_k": 1}
    for count in (600, 500):
        given = {"path": str(capture), "point_count": count, "workers": 1}
        data = {"class_path": "CaptureDataModule", "init_args": given}
        more = {"data": json.dumps(data), "model.densification.init_args.start": 99}
        assert main(["fit", *_arguments(capture, tmp_path, **options, **more)]) == 0
    state = torch.load(tmp_path / "checkpoints/step_000013.ckpt", weights_only=False)["state_dict"]
    assert len(state["model.means"]) == 500


def test_ctrl_c(capture, tmp_path, monkeypatch, capsys):
    """Lightning turns it into an exit with 1."""

    def stopped(*_):
        raise SystemExit(1)

    monkeypatch.setattr("gaussian_swaying.training.cli.make_cli", stopped)
    assert main(["fit"]) == 130
    assert "--ckpt_path" in capsys.readouterr().err


def test_the_message_of_a_worker_is_one_sentence():
    text = 'Caught ValueError in DataLoader worker process 0.\nOriginal\n  File "x"\nValueError: The image is cut.\n'
    assert parser_sentence(text) == "The image is cut."


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
    """Added to the four by its class path; a weight on the command line leaves the others."""
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


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model.sh_degree": 7}, ["`sh_degree`", "7"]),
        ({"trainer.gradient_clip_val": 1}, ["gradient"]),
        ({"ckpt_path": "README.ckpt"}, ["README.ckpt"]),
        ({"ckpt_path": str(QUICK)}, ["quick_cpu.yaml is no checkpoint", "`--ckpt_path`"]),
        ({"model.loss_weights.siz": 1.0}, ["`loss_weights`", "siz"]),
        ({"model.densification.init_args.every": 0}, ["`densification.every`"]),
        ({"model.bogus": 1}, ["bogus"]),
        ({"model.seed": "many"}, ["model.seed", "many"]),
        ({"ckpt_path": "nowhere.ckpt"}, ["nowhere.ckpt"]),
        ({"data.init_args.path": "nowhere"}, ["nowhere does not exist"]),
        ({"model.densification": "MCMCDensification"}, ["MCMCDensification needs CUDA"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_settings(options, words, capture, tmp_path, capsys):
    arguments = _arguments(capture, tmp_path)
    if "model.densification" in options:
        arguments = [part for part in arguments if "densification" not in part]
    assert main(["fit", *arguments, *(f"--{name}={value}" for name, value in options.items())]) == 2
    error = capsys.readouterr().err.split("error: ")[-1]
    for word in words:
        assert word in error, error
    assert error.count("\n") == 1


def test_the_tool_as_a_program(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "tools/train.py"), "fit", "--config", str(QUICK), "--trainer.max_steps=many"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "error: " in done.stderr
    assert "max_steps" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
