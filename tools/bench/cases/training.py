"""Training runs for ``bench.py train``: a bare gsplat loop, Lightning, variants of the fox, and a flag's ablation."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from einops import rearrange
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from bench.case import PICTURES, Case, Measurement, at_once, names, option
from bench.clock import Clock
from bench.problems.surface_quality import surface_quality
from bench.record import ROOT, Row
from gaussian_swaying.cli.train import make_cli
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.training.data.datamodule import CaptureDataModule, EndlessShuffle, TrainingImage
from gaussian_swaying.training.data.generated_datamodule import GeneratedDataModule
from gaussian_swaying.training.losses import photometric_loss
from gaussian_swaying.training.optimizers import LearningRates, means_rate
from gaussian_swaying.training.panels import panel

SECTIONS = ("pair", "variants", "flag", "photos")
"""What ``bench.py train`` measures; ``photos`` is the recipe for a CPU, which is measured there alone."""

_NO_SURFACE = {"anisotropy": 0.0, "entropy": 0.0, "size": 0.0}
_MCMC = [f"--config={ROOT}/configs/train/mcmc.yaml"]
_DEFAULT = ["--model.densification=DefaultDensification"]
_CONSISTENT = ["--data.init_args.points=consistent"]


def _weights(**weights: float) -> list[str]:
    return [f"--model.loss_weights.{name}={weight}" for name, weight in weights.items()]


_PLAIN = _weights(**_NO_SURFACE)
_DENSE = [*_PLAIN, *_DEFAULT]

FOX_VARIANTS: dict[str, tuple[str, list[str]]] = {
    "surface": ("all surface losses, paper's weights", []),
    "consistent": ("initial points from photo-consistency", [*_PLAIN, *_CONSISTENT]),
    "mcmc": ("MCMC, 300,000 Gaussians", [*_PLAIN, *_MCMC]),
    "mcmc_consistent": (
        "MCMC, 300,000 Gaussians, points from photo-consistency",
        [*_PLAIN, *_MCMC, *_CONSISTENT],
    ),
    "absgrad": (
        "absolute gradients, threshold 0.0008",
        [*_DENSE, "--model.densification.absgrad=true", "--model.densification.grow_grad2d=0.0008"],
    ),
    "schedule": (
        "densification until step 4,000, one more harmonic degree every 500",
        [*_DENSE, "--model.densification.stop=4000", "--model.sh_every=500"],
    ),
    "degree_1": ("harmonics of degree 1", [*_PLAIN, "--model.sh_degree=1"]),
    "selective": ("gsplat's selective Adam", [*_PLAIN, "--model.optimizer=selective_adam"]),
    "packed": ("gsplat's packed projection", [*_PLAIN, "--model.packed=true"]),
    "passes": ("densification every 200 images", [*_DENSE, "--model.densification.every=200"]),
    "settled": ("densification until step 4,000", [*_DENSE, "--model.densification.stop=4000"]),
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


def _seconds(clock: Clock) -> float:
    """Seconds since the first mark, after waiting for the device."""
    clock.mark()
    return 1e-3 * sum(clock.read())


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
    parts = ("means", "scales", "quats", "opacities", "sh0", "shN")
    parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(getattr(start, name).detach()) for name in parts})
    fused = device.type == "cuda"
    optimizers = {
        name: torch.optim.Adam(
            [parameters[name]],
            lr=getattr(rates, name) * (scene_scale if name == "means" else 1.0),
            eps=1e-15,
            fused=fused,
        )
        for name in parts
    }
    views = [view.to(device) for view in (data.train_dataloader().dataset[i] for i in range(_count(data)))]
    photos = [view.image for view in views]
    poses = [view.camera.world_to_camera[None].float() for view in views]
    lenses = [view.camera.intrinsics[None].float() for view in views]
    strategy = DefaultStrategy()
    state = strategy.initialize_state(scene_scale=scene_scale)
    if fused:
        torch.cuda.reset_peak_memory_stats()
    clock = Clock(device)
    clock.mark()
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
    seconds = _seconds(clock)
    for name in parts:
        setattr(start, name, parameters[name])
    return _finish(start, data, seconds, steps)


def _count(data: CaptureDataModule) -> int:
    return len(data.capture.split("train"))


def lightning_run(
    config: str, more: list[str], steps: int, folder: Path, look: Callable[[Any, Any], Row] | None = None
) -> Row:
    """The same with the classes of tools/train.py: logs, progress bar, and a checkpoint and .ply at the end."""
    from lightning.pytorch.callbacks import Callback

    class Timer(Callback):
        """Seconds from the first image to the last; it comes before the checkpoints in the list of callbacks."""

        seconds = 0.0

        def on_train_start(self, *_: Any) -> None:
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
            clock.wait()
            clock.mark()

        def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
            if trainer.global_step == steps:
                self.seconds = _seconds(clock)

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    cli, clock, timer = make_cli(_arguments(config, more, steps, folder), run=False), Clock(device), Timer()
    trainer: Any = cli.trainer
    trainer.callbacks.insert(0, timer)
    trainer.fit(cli.model, cli.datamodule)
    with_files = _seconds(clock)
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


Job = tuple[str, str, int, Path | None]  # the name of a run, its photos, its images, and its picture


def run_apart(section: str, jobs: list[Job], folder: Path, most: int) -> Iterator[Measurement]:
    """Several runs in processes of their own, at most so many at a time.

    The runs are spread over the GPUs. Several runs on one GPU slow each other down.
    """
    gpus = max(torch.cuda.device_count(), 1)
    on_one = -(-min(most, len(jobs)) // gpus)
    free: queue.SimpleQueue[int] = queue.SimpleQueue()  # a GPU for each run that may go on at once
    for number in range(most):
        free.put(number % gpus)

    def work(name: str, path: str, steps: int, picture: Path | None) -> Row:
        gpu = free.get()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "tools"), *sys.path])}
        environment |= {"CUDA_VISIBLE_DEVICES": _visible(gpu)} if gpus > 1 else {}
        target = folder / f"{name.replace(':', '_')}.json"
        command = [sys.executable, "-m", "bench.cases.training", name, path, str(steps), str(target)]
        command += [] if picture is None else ["--picture", str(picture)]
        log = target.with_suffix(".log")
        with log.open("w") as told:
            done = subprocess.run(command, cwd=ROOT, env=environment, stdout=told, stderr=subprocess.STDOUT)
        free.put(gpu)
        if done.returncode:
            return {"failed": log.read_text()[-400:]}
        return json.loads(target.read_text()) | {"runs_per_device": on_one}

    yield from at_once(most, (((section, job[0]), partial(work, *job)) for job in jobs))


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The wanted sections."""
    wanted, capture = options.only, options.capture
    if {"pair", "variants", "photos"} & set(wanted) and not capture:
        raise SystemExit("the capture is missing: pass its folder with --capture, or skip it with --only flag")
    with tempfile.TemporaryDirectory() as scratch:
        folder, pictures = Path(scratch), Path(options.pictures)
        if "photos" in wanted:
            views = options.views and Path(options.views)
            yield ("photos", "photos_cpu"), partial(photos_run, capture, folder / "photos", views)
        if "pair" in wanted:
            pair = ("bare", "lightning")
            for name in pair:
                run(name, capture, 60, folder / "warm")  # loads the kernels
            result["pair"] = {name: [] for name in pair}
            for turn in range(options.repeats):
                for name in pair:
                    work = partial(run, name, capture, options.steps, folder / f"{name}_{turn}")
                    yield ("pair", name, {"turn": turn}), work
        if "flag" in wanted:
            seen = {name: pictures / f"training_flag_{name}.png" for name in options.rows}
            flags: list[Job] = [(f"flag:{name}", options.flag, options.flag_steps, seen[name]) for name in seen]
            yield from run_apart("flag", flags, folder, options.at_once)
        if "variants" in wanted:
            variants: list[Job] = [(name, capture, options.steps, None) for name in options.variants]
            yield from run_apart("variants", variants, folder, options.at_once)


CASE = Case(
    "Measure training: a bare gsplat loop and Lightning, and the effect of the surface losses.",
    rows,
    (
        option("--capture", "folder of photos for configs/train/fox.yaml"),
        option("--flag", "folder of the generated flag's photos", default="outputs/captures/flag_800"),
        names("--only", SECTIONS, default=("pair", "variants", "flag")),
        option("--views", "picture of the held-out photos beside what `photos` drew, not in the docs"),
        names("--variants", FOX_VARIANTS, "variants of the capture"),
        names("--rows", FLAG_ROWS, "rows of the flag"),
        option("--steps", "images of a training run on the capture", type=int, default=7000),
        option("--flag_steps", "images of a training run on the flag", type=int, default=30_000),
        option("--repeats", "runs of the bare loop and of Lightning, alternating", type=int, default=2),
        option("--at_once", "variants and rows trained at the same time", type=int, default=4),
        PICTURES,
    ),
)


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
