"""Training runs for ``bench.py train``: a bare gsplat loop, Lightning, variants of the fox, and a flag's ablation."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from einops import rearrange
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from bench.problems.surface_quality import surface_quality
from bench.record import chosen
from gaussian_swaying.cli.train import make_cli
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.training.data.datamodule import CaptureDataModule, EndlessShuffle, TrainingImage
from gaussian_swaying.training.data.generated_datamodule import GeneratedDataModule
from gaussian_swaying.training.losses import photometric_loss
from gaussian_swaying.training.optimizers import LearningRates, means_rate
from gaussian_swaying.training.panels import panel

ROOT = Path(__file__).resolve().parents[3]
Row = dict[str, Any]

SECTIONS = ("pair", "variants", "flag", "photos")
"""What ``bench.py train`` measures; ``photos`` is the recipe for a CPU, which is measured there alone."""

_NO_SURFACE = {"anisotropy": 0.0, "entropy": 0.0, "size": 0.0}
_MCMC = [f"--config={ROOT}/configs/train/mcmc.yaml"]
_DEFAULT = ["--model.densification=DefaultDensification"]
_CONSISTENT = ["--data.init_args.points=consistent"]


def _weights(**weights: float) -> list[str]:
    return [f"--model.loss_weights.{name}={weight}" for name, weight in weights.items()]


FOX_VARIANTS: dict[str, tuple[str, list[str]]] = {
    "surface": ("all surface losses, paper's weights", []),
    "consistent": ("initial points from photo-consistency", [*_weights(**_NO_SURFACE), *_CONSISTENT]),
    "mcmc": ("MCMC, 300,000 Gaussians", [*_weights(**_NO_SURFACE), *_MCMC]),
    "mcmc_consistent": (
        "MCMC, 300,000 Gaussians, points from photo-consistency",
        [*_weights(**_NO_SURFACE), *_MCMC, *_CONSISTENT],
    ),
    "absgrad": (
        "absolute gradients, threshold 0.0008",
        [
            *_weights(**_NO_SURFACE),
            *_DEFAULT,
            "--model.densification.absgrad=true",
            "--model.densification.grow_grad2d=0.0008",
        ],
    ),
    "schedule": (
        "densification until step 4,000, one more harmonic degree every 500",
        [*_weights(**_NO_SURFACE), *_DEFAULT, "--model.densification.stop=4000", "--model.sh_every=500"],
    ),
    "degree_1": ("harmonics of degree 1", [*_weights(**_NO_SURFACE), "--model.sh_degree=1"]),
    "hooks_1": ("Lightning's hooks after every image", [*_weights(**_NO_SURFACE), "--model.hooks_every=1"]),
    "selective": ("gsplat's selective Adam", [*_weights(**_NO_SURFACE), "--model.optimizer=selective_adam"]),
    "packed": ("gsplat's packed projection", [*_weights(**_NO_SURFACE), "--model.packed=true"]),
    "passes": (
        "densification every 200 images",
        [*_weights(**_NO_SURFACE), *_DEFAULT, "--model.densification.every=200"],
    ),
    "settled": (
        "densification until step 4,000",
        [*_weights(**_NO_SURFACE), *_DEFAULT, "--model.densification.stop=4000"],
    ),
}
"""Variants of the schedule of the bare loop on the fox: name to description and command line."""

_ALL_SURFACE = {"anisotropy": 10.0, "entropy": 0.01, "size": 0.01}

FLAG_ROWS: dict[str, tuple[str, dict[str, float]]] = {
    "none": ("photometric only", _NO_SURFACE),
    "anisotropy": ("+ anisotropy", _NO_SURFACE | {"anisotropy": 10.0}),
    "entropy": ("+ entropy", _NO_SURFACE | {"anisotropy": 10.0, "entropy": 0.01}),
    "size": ("+ size (all)", _ALL_SURFACE),
    "settled": ("all, densification until image 5,000: `configs/train/flag.yaml`", _ALL_SURFACE),
}
"""Rows of the ablation of the surface losses: name to description and weights.

The first four densify until image 15,000, as 3DGS does; the last follows the configuration.
"""


def _arguments(config: str, more: list[str], steps: int, folder: Path) -> list[str]:
    return [
        f"--config={ROOT}/configs/train/{config}.yaml",
        *more,
        f"--trainer.max_steps={steps}",
        "--trainer.limit_val_batches=0",
        f"--checkpoint.every_n_train_steps={steps}",
        f"--trainer.default_root_dir={folder}",
    ]


class _Clock:
    """Seconds between two points, after waiting for the GPU."""

    def __init__(self) -> None:
        self.wait()
        self.begin = time.perf_counter()

    @staticmethod
    def wait() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    def seconds(self) -> float:
        self.wait()
        return time.perf_counter() - self.begin


@torch.no_grad()
def evaluate(model: GaussianSurfaceModel, views: list[TrainingImage], background: Tensor | None = None) -> Row:
    """PSNR [dB] and SSIM of held-out views, each the mean over the views."""
    renderer = make_renderer(model.means.device)
    found: dict[str, list[float]] = {"psnr_db": [], "ssim": []}
    for view in views:
        on_device = view.to(model.means.device)
        image, alpha = on_device.image, on_device.alpha
        target = image if alpha is None else image * alpha
        drawn = renderer.render_splat(
            model.means, model.quats, model.scales, model.opacity(), model.sh, on_device.camera, background
        )
        one, two = (rearrange(picture, "h w c -> 1 c h w") for picture in (drawn.color.clamp(0, 1), target))
        found["psnr_db"].append(float(peak_signal_noise_ratio(one, two, data_range=1.0)))
        ssim: Any = structural_similarity_index_measure(one, two, data_range=1.0)
        found["ssim"].append(float(ssim))
    return {name: sum(values) / len(values) for name, values in found.items()}


def _finish(model: GaussianSurfaceModel, data: CaptureDataModule, seconds: float, steps: int) -> Row:
    memory = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else None
    row: Row = {"seconds": seconds, "steps": steps, "gaussians": len(model), "memory_bytes": memory}
    views = [data.test_dataloader().dataset[i] for i in range(len(data.capture.split("test")))]
    return row | evaluate(model, views) | {"test_views": len(views)}


def bare_loop(config: str, more: list[str], steps: int, device: torch.device) -> Row:
    """The schedule of a configuration as a plain loop over gsplat, with only the photometric loss.

    The images and cameras are on the device from the start; nothing is logged, checked or saved.
    """
    from gsplat import DefaultStrategy, rasterization

    cli = make_cli(_arguments(config, more, steps, Path("unused")), run=False)
    data: Any = cli.datamodule
    data.setup("fit")
    rates = LearningRates()
    scene_scale = data.scene_scale
    start = GaussianSurfaceModel.from_cloud(data.initial_cloud(3)).to(device)
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(getattr(start, name).detach()) for name in names})
    fused = device.type == "cuda"
    optimizers = {
        name: torch.optim.Adam(
            [parameters[name]],
            lr=getattr(rates, name) * (scene_scale if name == "means" else 1.0),
            eps=1e-15,
            fused=fused,
        )
        for name in names
    }
    views = [view.to(device) for view in (data.train_dataloader().dataset[i] for i in range(_count(data)))]
    photos = [view.image for view in views]
    poses = [view.camera.world_to_camera[None].float() for view in views]
    lenses = [view.camera.intrinsics[None].float() for view in views]
    strategy = DefaultStrategy()
    state = strategy.initialize_state(scene_scale=scene_scale)
    if fused:
        torch.cuda.reset_peak_memory_stats()
    clock = _Clock()
    for step, index in enumerate(itertools.islice(EndlessShuffle(len(views), data.seed), steps)):
        optimizers["means"].param_groups[0]["lr"] = means_rate(rates, scene_scale, step, steps)
        degree = min(step // 1000, 3)
        height, width = photos[index].shape[:2]
        image, _, info = rasterization(
            parameters["means"],
            parameters["quats"],
            parameters["scales"].exp(),
            parameters["opacities"].sigmoid(),
            torch.cat([parameters["sh0"], parameters["shN"]], 1),
            poses[index],
            lenses[index],
            width,
            height,
            sh_degree=degree,
            packed=False,
        )
        loss = photometric_loss(image[0], photos[index])
        strategy.step_pre_backward(parameters, optimizers, state, step, info)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(parameters, optimizers, state, step, info, packed=False)
    seconds = clock.seconds()
    model = start
    for name in names:
        setattr(model, name, parameters[name])
    return _finish(model, data, seconds, steps)


def _count(data: CaptureDataModule) -> int:
    return len(data.capture.split("train"))


def lightning_run(
    config: str, more: list[str], steps: int, folder: Path, look: Callable[[Any, Any], Row] | None = None
) -> Row:
    """The same with the classes of tools/train.py: logs, progress bar, and a checkpoint and .ply at the end."""
    from lightning.pytorch.callbacks import Callback

    class Timer(Callback):
        """Seconds from the first image to the last; it comes before the checkpoints in the list of callbacks."""

        clock: _Clock
        seconds = 0.0

        def on_train_start(self, *_: Any) -> None:
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            self.clock = _Clock()

        def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
            if trainer.global_step == steps:
                self.seconds = self.clock.seconds()

    cli = make_cli(_arguments(config, more, steps, folder), run=False)
    timer = Timer()
    trainer: Any = cli.trainer
    trainer.callbacks.insert(0, timer)
    trainer.fit(cli.model, cli.datamodule)
    with_files = timer.clock.seconds()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = cli.model.to(device).splat
    data: Any = cli.datamodule
    row = _finish(model, data, timer.seconds, steps) | {"seconds_with_files": with_files}
    return row if look is None else row | look(model, data)


def _flag_look(picture: Path | None) -> Callable[[GaussianSurfaceModel, GeneratedDataModule], Row]:
    def look(model: GaussianSurfaceModel, data: GeneratedDataModule) -> Row:
        if picture is not None:
            from imageio.v3 import imwrite

            views = data.test_dataloader().dataset
            view = views[min(3, len(data.capture.split("test")) - 1)].to(model.means.device)
            alpha = view.alpha
            photo = view.image if alpha is None else view.image * alpha
            pixels = panel(model, make_renderer(model.means.device), view.camera, photo)
            small = torch.nn.functional.avg_pool2d(rearrange(pixels, "h w c -> 1 c h w"), 2)
            small = rearrange(small, "1 c h w -> h w c")
            picture.parent.mkdir(parents=True, exist_ok=True)
            imwrite(picture, (small * 255).round().to(torch.uint8).cpu().numpy())
        return surface_quality(model, data.generated)

    return look


def flag_options(row: str) -> list[str]:
    """Command line for one of FLAG_ROWS."""
    return _weights(**FLAG_ROWS[row][1]) + ([] if row == "settled" else ["--model.densification.stop=15000"])


def run(name: str, path: str, steps: int, folder: Path, picture: Path | None = None) -> Row:
    """One run by name: ``bare``, ``lightning``, a name in FOX_VARIANTS, or ``flag:`` and a name in FLAG_ROWS."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    at = [f"--data.init_args.path={path}"]
    if name.startswith("flag:"):
        more = [*at, *flag_options(name.removeprefix("flag:"))]
        return lightning_run("flag", more, steps, folder, _flag_look(picture))
    if name == "bare":
        return bare_loop("fox", at, steps, device)
    more = _weights(**_NO_SURFACE) if name == "lightning" else FOX_VARIANTS[name][1]
    return lightning_run("fox", [*at, *more], steps, folder)


def photos_run(path: str, folder: Path, picture: Path | None) -> Row:
    """The recipe of configs/train/photos_cpu.yaml: what it reaches, and the processor time of all of it."""
    steps = yaml.safe_load((ROOT / "configs/train/photos_cpu.yaml").read_text())["trainer"]["max_steps"]

    def look(model: GaussianSurfaceModel, data: CaptureDataModule) -> Row:
        spent = time.process_time() - begin
        views = data.test_dataloader().dataset
        camera = views[0].camera
        if picture is not None:
            from imageio.v3 import imwrite

            drawn = [panel(model, make_renderer(model.means.device), view.camera, view.image) for view in views]
            imwrite(picture, (torch.cat(drawn) * 255).round().to(torch.uint8).numpy())
        photos = {"photos": len(data.capture.split("train")), "width": camera.width, "height": camera.height}
        return photos | {"processor_s": spent, "threads": torch.get_num_threads()}

    begin = time.process_time()
    row = lightning_run("photos_cpu", [f"--data.init_args.path={path}"], steps, folder, look)
    for name in ("seconds", "seconds_with_files", "memory_bytes"):  # a CPU may be shared: its own time is shown
        del row[name]
    return row


def _visible(gpu: int) -> str:
    """The value of CUDA_VISIBLE_DEVICES for one of the GPUs that this process sees."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return listed.split(",")[gpu] if listed else str(gpu)


def run_apart(
    jobs: list[tuple[str, str, int, Path | None]], folder: Path, at_once: int, done: Callable[[str, Row], None]
) -> None:
    """Do several runs in separate processes, and call ``done`` when each ends.

    The runs are spread over the GPUs. Several runs on one GPU slow each other down.
    """
    gpus = max(torch.cuda.device_count(), 1)
    waiting = list(jobs)
    running: dict[str, tuple[subprocess.Popen[bytes], Path, Any, int]] = {}
    while waiting or running:
        while waiting and len(running) < at_once:
            name, path, steps, picture = waiting.pop(0)
            busy = [gpu for _, _, _, gpu in running.values()]
            gpu = min(range(gpus), key=busy.count)
            environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "tools"), *sys.path])}
            environment |= {"CUDA_VISIBLE_DEVICES": _visible(gpu)} if gpus > 1 else {}
            target = folder / f"{name.replace(':', '_')}.json"
            command = [sys.executable, "-m", "bench.cases.training", name, path, str(steps), str(target)]
            command += [] if picture is None else ["--picture", str(picture)]
            log = target.with_suffix(".log").open("w")
            process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT)
            running[name] = (process, target, log, gpu)
        time.sleep(0.2)
        for name in [name for name, (process, _, _, _) in running.items() if process.poll() is not None]:
            process, target, log, _ = running.pop(name)
            log.close()
            if process.returncode == 0:
                on_one = -(-min(at_once, len(jobs)) // gpus)
                row = json.loads(target.read_text()) | {"runs_per_device": on_one}
            else:
                row = {"failed": target.with_suffix(".log").read_text()[-400:]}
            print(f"{name}: {json.dumps(row)}", flush=True)
            done(name, row)


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py train``."""
    command.add_argument("--capture", help="folder of photos for configs/train/fox.yaml")
    command.add_argument("--flag", default="outputs/captures/flag_800", help="folder of the generated flag's photos")
    command.add_argument(
        "--only", default="pair,variants,flag", help=f"some of {', '.join(SECTIONS)}, separated by commas"
    )
    command.add_argument("--views", help="picture of the held-out photos beside what `photos` drew, not in the docs")
    command.add_argument(
        "--variants", default=",".join(FOX_VARIANTS), help="variants of the capture, separated by commas"
    )
    command.add_argument("--rows", default=",".join(FLAG_ROWS), help="rows of the flag, separated by commas")
    command.add_argument("--steps", type=int, default=7000, help="images of a training run on the capture")
    command.add_argument("--flag_steps", type=int, default=30_000, help="images of a training run on the flag")
    command.add_argument("--repeats", type=int, default=2, help="runs of the bare loop and of Lightning, alternating")
    command.add_argument("--at_once", type=int, default=4, help="variants and rows trained at the same time")
    command.add_argument("--pictures", default=str(ROOT / "docs" / "pictures"), help="folder of the flag's pictures")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result``, saving it after each run."""
    wanted = chosen("--only", options.only, SECTIONS)
    if {"pair", "variants", "photos"} & set(wanted) and not options.capture:
        raise SystemExit("the capture is missing: pass its folder with --capture, or skip it with --only flag")

    def keep(section: str) -> Callable[[str, Row], None]:
        def done(name: str, row: Row) -> None:
            result.setdefault(section, {})[name] = row
            save(result)

        return done

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if "photos" in wanted:
            row = photos_run(options.capture, folder / "photos", options.views and Path(options.views))
            keep("photos")("photos_cpu", row)
        if "pair" in wanted:
            run("bare", options.capture, 60, folder / "warm")  # loads the kernels
            run("lightning", options.capture, 60, folder / "warm")
            result["pair"] = {"bare": [], "lightning": []}
            for turn in range(options.repeats):
                for name in ("bare", "lightning"):
                    row = run(name, options.capture, options.steps, folder / f"{name}_{turn}")
                    print(f"{name}: {json.dumps(row)}", flush=True)
                    result["pair"][name].append(row)
                    save(result)
        if "flag" in wanted:
            jobs: list[Any] = [
                (f"flag:{name}", options.flag, options.flag_steps, Path(options.pictures) / f"training_flag_{name}.png")
                for name in options.rows.split(",")
            ]
            run_apart(jobs, folder, options.at_once, keep("flag"))
        if "variants" in wanted:
            jobs = [(name, options.capture, options.steps, None) for name in options.variants.split(",")]
            run_apart(jobs, folder, options.at_once, keep("variants"))


def main() -> None:
    """Do one run, for :func:`run_apart`."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("name")
    parser.add_argument("path")
    parser.add_argument("steps", type=int)
    parser.add_argument("target")
    parser.add_argument("--picture")
    options = parser.parse_args()
    target = Path(options.target)
    picture = None if options.picture is None else Path(options.picture)
    row = run(options.name, options.path, options.steps, target.with_suffix(""), picture)
    target.write_text(json.dumps(row))


if __name__ == "__main__":
    main()
