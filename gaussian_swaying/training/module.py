"""The training of surface-aligned Gaussians as a Lightning module."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from einops import rearrange
from lightning.pytorch.utilities.types import STEP_OUTPUT
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.factory import make_renderer
from gaussian_swaying.rendering.protocol import SplatOutput, SplatRenderer
from gaussian_swaying.training.densification import PARAMETERS, DefaultDensification, Densification
from gaussian_swaying.training.losses import SSIM_TAPS, LossInputs, LossTerm, TotalLoss
from gaussian_swaying.training.panels import LPIPS_SIDE, lpips_metric, panel


class TrainingDiverged(RuntimeError):  # noqa: N818
    """A loss or a Gaussian is not finite any more; the message names the step and the last good checkpoint.

    Args:
        step: Number of images trained on before the one that failed.
        what: What is not finite.
        checkpoint: Last checkpoint written before, if any.
    """

    def __init__(self, step: int, what: str, checkpoint: str | None = None) -> None:
        self.step, self.checkpoint = step, checkpoint
        kept = f"the last good checkpoint is {checkpoint}" if checkpoint else "there is no checkpoint yet"
        super().__init__(
            f"Training diverged at step {step}: {what} is not finite; {kept}. Remedy: lower the learning rates "
            "(`model.rates`) or the weight of the loss that grew (`model.loss_weights`)."
        )


_CLOCK_STEP = 20_000_000  # [ns] by which times of files may lag behind the clock


class _Pending:
    """The last loss, on its way to the host, which does not wait for it."""

    def __init__(self, device: torch.device) -> None:
        self.step: int | None = None
        on_gpu = device.type == "cuda"
        self._host = torch.zeros((), pin_memory=on_gpu)
        self._arrived = torch.cuda.Event() if on_gpu else None

    def send(self, step: int, loss: Tensor) -> None:
        self.step = step
        self._host.copy_(loss, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record()

    def take(self) -> float:
        """Wait for the loss and forget it."""
        if self._arrived is not None:
            self._arrived.synchronize()
        self.step = None
        return float(self._host)


def _random_state(device: torch.device) -> dict[str, Tensor]:
    state = {"cpu": torch.get_rng_state()}
    return state | {"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else state


def _set_random_state(state: Mapping[str, Tensor], device: torch.device) -> None:
    torch.set_rng_state(state["cpu"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam, one for each parameter, with the values of gsplat's example trainer.

    Attributes:
        means: Centres, as a share of the scene's extent; decays exponentially.
        means_final: Share of ``means`` that is left after the last step.
        scales: Logarithms of the scales.
        quats: Quaternions.
        opacities: Logits of the opacities.
        sh0: Constant harmonics.
        shN: The other harmonics.
    """

    means: float = 1.6e-4
    means_final: float = 0.01
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20  # noqa: N815

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "means_final"):
            check_positive(f"rates.{name}", getattr(self, name), allow_zero=name != "means_final")


def means_rate(rates: LearningRates, scene_scale: float, step: int, max_steps: int) -> float:
    """Learning rate of the centres at a step: from ``rates.means`` times the scene's extent, exponentially downwards.

    Args:
        rates: The rates.
        scene_scale: Extent of the scene [scene units].
        step: Number of images trained on before.
        max_steps: Number of images in all.

    Returns:
        The rate [scene units].
    """
    share = min(step / max_steps, 1.0) if max_steps > 0 else 0.0
    return rates.means * scene_scale * rates.means_final**share


class SplatTrainer(lightning.LightningModule):
    """Trains a :class:`~gaussian_swaying.gaussians.model.GaussianSurfaceModel` on photos with known cameras.

    A step is one image, also for ``trainer.max_steps``: six optimisers step for it, of which Lightning counts one. Its
    random numbers come from a stream of their own, which starts from the seed and is kept in checkpoints, so that
    nothing else changes them and a resumed training continues exactly.

    Batches have items ``image`` (H, W, 3), ``alpha`` (H, W, 1) or None, ``camera`` and ``name``. Where there is an
    alpha, the image holds colours that are not multiplied with it. The Gaussians to start from come from ``init_ply``,
    or else from ``datamodule.initial_cloud(sh_degree)``, and the extent of the scene from ``datamodule.scene_scale``.

    Args:
        loss_weights: Weights of the losses by name (``rgb``, ``anisotropy``, ``entropy``, ``size`` and further terms),
            in place of the paper's, see :class:`~gaussian_swaying.training.losses.TotalLoss`; 0 leaves one out.
        loss_terms: Further losses by name, or others in place of those four.
        densification: Which Gaussians are copied, split and removed.
        rates: Learning rates.
        sh_degree: Highest degree of the spherical harmonics, 0 to 3.
        sh_every: Steps after which the degree in use rises by one; 0 for all from the start.
        background: Behind the Gaussians: ``random`` in each step where a photo has an alpha and black where it has
            none, ``black``, ``white``, or one colour from 0 to 1.
        scene_scale: Extent of the scene [scene units], which learning rates and thresholds refer to; that of the
            cameras (``datamodule.scene_scale``) by default.
        seed: Seed of backgrounds and new Gaussians.
        panels: Number of validation images that are written as panels of photo, render, normals and area.
        log_every: Steps between logged values.
        output: Folder of panels and of the ``point_cloud.ply`` at the end; ``trainer.default_root_dir`` by default.
        init_ply: Splat to start from.
        lpips: Backbone of the LPIPS metric, used only if its weights are on disk; null for none.

    Attributes:
        renderer: What draws; that of :func:`~gaussian_swaying.rendering.factory.make_renderer` if it is None.

    Raises:
        ValueError: If a value is out of range.
    """

    renderer: SplatRenderer | None

    def __init__(
        self,
        loss_weights: dict[str, float] | None = None,
        loss_terms: dict[str, LossTerm] | None = None,
        densification: Densification | None = None,
        rates: LearningRates | None = None,
        sh_degree: int = 3,
        sh_every: int = 1000,
        background: Literal["random", "black", "white"] | list[float] = "random",
        scene_scale: float | None = None,
        seed: int = 0,
        panels: int = 3,
        log_every: int = 50,
        output: str | None = None,
        init_ply: str | None = None,
        lpips: Literal["alex", "vgg", "squeeze"] | None = "alex",
    ) -> None:
        super().__init__()
        if sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"Expected `sh_degree` to be 0, 1, 2 or 3, but got {sh_degree}.")
        for name, value in (("sh_every", sh_every), ("panels", panels), ("seed", seed)):
            check_positive(name, value, allow_zero=True)
        check_positive("log_every", log_every)
        if scene_scale is not None:
            check_positive("scene_scale", scene_scale)
        self.automatic_optimization = False
        self.loss = TotalLoss(loss_terms, loss_weights)
        self.densification = DefaultDensification() if densification is None else densification
        self.rates = LearningRates() if rates is None else rates
        self.sh_degree, self.sh_every = sh_degree, sh_every
        self.random_background = background == "random"
        shade = 1.0 if background == "white" else 0.0
        fixed = (shade,) * 3 if isinstance(background, str) else check_vector("background", background)
        if min(fixed) < 0 or max(fixed) > 1:
            raise ValueError(f"Expected `background` to be a colour from 0 to 1, but got {list(fixed)}.")
        self.register_buffer("fixed_background", torch.tensor(fixed), persistent=False)
        self._black = max(fixed) == 0.0
        self.scene_scale = scene_scale
        self.seed, self.panels, self.log_every = seed, panels, log_every
        self.output, self.init_ply = output, init_ply
        self.model: GaussianSurfaceModel | None = None
        self._metrics: dict[str, list[Tensor]] = {}  # of each image of an evaluation
        self._lpips_net = lpips
        self._lpips: list[Any] = []  # in a list, so that its weights stay out of the checkpoints
        self.renderer = None
        self._made: dict[str, SplatRenderer] = {}  # by kind of device: Lightning moves the model after a fit
        self._pending: _Pending | None = None
        self._seen = 0  # images that a checkpoint was trained on
        self._begun = 0  # [ns] when the training did
        self._random: dict[str, Tensor] = {}  # state of the generators between two steps, by kind of device

    fixed_background: Tensor

    # ---- what is trained

    @property
    def splat(self) -> GaussianSurfaceModel:
        """The Gaussians; RuntimeError before there are any."""
        if self.model is None:
            raise RuntimeError("There are no Gaussians yet: they are made when the training starts.")
        return self.model

    def setup(self, stage: str) -> None:
        """Make the Gaussians to start from, unless a checkpoint has brought them."""
        datamodule: Any = getattr(self.trainer, "datamodule", None)
        if self.scene_scale is None:
            self.scene_scale = float(getattr(datamodule, "scene_scale", 1.0))
            check_positive("scene_scale", self.scene_scale)
        if self.model is None:
            if self.init_ply is not None:
                cloud = read_gaussians(self.init_ply)
                wanted = (self.sh_degree + 1) ** 2
                sh = cloud.sh[:, :wanted]
                missing = sh.new_zeros(len(cloud), wanted - sh.shape[1], 3)
                cloud = GaussianCloud(
                    cloud.means, cloud.quats, cloud.scales, cloud.opacities, torch.cat([sh, missing], 1), cloud.normals
                )
            elif hasattr(datamodule, "initial_cloud"):
                cloud = datamodule.initial_cloud(self.sh_degree)
            else:
                raise ValueError("Expected Gaussians to start from: give `init_ply`, or data that bring points.")
            self.model = GaussianSurfaceModel.from_cloud(cloud)
        # normals of a file would have to follow every split
        self.model.reference_normals = None

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """One Adam for each parameter, in the order of :data:`PARAMETERS`."""
        assert self.scene_scale is not None
        fused = self.splat.means.device.type == "cuda"
        rates = {name: getattr(self.rates, name) for name in PARAMETERS} | {
            "means": self.rates.means * self.scene_scale
        }
        return [
            torch.optim.Adam([getattr(self.splat, name)], lr=rates[name], eps=1e-15, fused=fused) for name in PARAMETERS
        ]

    def on_fit_start(self) -> None:
        """Refuse what would train wrongly without a word."""
        self._begun = time.time_ns()
        if self.trainer.world_size > 1:
            raise ValueError(
                f"Expected one device for a training, but got {self.trainer.world_size}: use trainer.devices 1."
            )
        if self.trainer.precision not in ("32-true", "32"):
            raise ValueError(
                f"Expected `trainer.precision` to be 32-true, but got {self.trainer.precision}: splats need float32."
            )

    def on_train_start(self) -> None:
        """Hand the Gaussians and their optimisers to the densification, after a checkpoint has been read."""
        assert self.scene_scale is not None
        optimizers = dict(zip(PARAMETERS, self._raw_optimizers(), strict=True))
        self.densification.attach(self.splat, optimizers, self.scene_scale)

    def _raw_optimizers(self) -> list[torch.optim.Optimizer]:
        found = self.optimizers(use_pl_optimizer=False)
        return found if isinstance(found, list) else [found]

    # ---- a step

    def active_degree(self, step: int) -> int:
        """Degree of the harmonics in use at a step."""
        return self.sh_degree if self.sh_every == 0 else min(step // self.sh_every, self.sh_degree)

    def render(
        self, camera: Camera, background: Tensor | None = None, degree: int | None = None, absgrad: bool = False
    ) -> SplatOutput:
        """Draw the Gaussians.

        Args:
            camera: The camera.
            background: Colour behind them, shape (3,); black when None.
            degree: Degree of the harmonics in use; all when None.
            absgrad: Whether absolute gradients are wanted.

        Returns:
            The picture.
        """
        splat = self.splat
        degree = self.sh_degree if degree is None else degree
        sh = torch.cat([splat.sh0, splat.shN[:, : (degree + 1) ** 2 - 1]], dim=1) if degree else splat.sh0
        return self._drawing().render_splat(
            splat.means, splat.quats, splat.scales, splat.opacity(), sh, camera, background, absgrad
        )

    def _drawing(self) -> SplatRenderer:
        if self.renderer is not None:
            return self.renderer
        device = self.splat.means.device
        if device.type not in self._made:
            self._made[device.type] = make_renderer(device)
        return self._made[device.type]

    def training_step(self, batch: Mapping[str, Any], batch_idx: int) -> STEP_OUTPUT:
        """One image: picture, losses, gradients, six optimisers, densification."""
        outside = _random_state(self.device)
        if self._random:
            _set_random_state(self._random, self.device)
        else:
            torch.manual_seed(self.seed)
        try:
            return self._train_on(batch, self.global_step)
        finally:
            self._random = _random_state(self.device)
            _set_random_state(outside, self.device)

    def _train_on(self, batch: Mapping[str, Any], step: int) -> Tensor:
        optimizers = self._raw_optimizers()
        means_optimizer, *others = optimizers
        assert self.scene_scale is not None
        rate = means_rate(self.rates, self.scene_scale, step, int(self.trainer.max_steps))
        means_optimizer.param_groups[0]["lr"] = rate
        target, alpha, background = self._target(batch, train=True)
        output = self.render(batch["camera"], background, self.active_degree(step), self.densification.absgrad)
        self._check_pending()  # of the step before: gsplat has waited for the GPU by now anyway
        splat = self.splat
        inputs = LossInputs(
            output.color, target, output.alpha, alpha, splat.means, splat.quats, splat.scales, splat.opacity(), step
        )
        loss, terms = self.loss(inputs)
        if not loss.requires_grad:  # a picture without Gaussians under a loss that looks only at it
            loss = loss + 0.0 * splat.means.sum()
        self.densification.before_backward(step, output.screen)
        self.manual_backward(loss)
        if self._pending is None:
            self._pending = _Pending(self.device)
        self._pending.send(step, loss.detach())
        if self.device.type != "cuda":
            self._check_pending()
        # Lightning counts a step of its wrapper as one of `max_steps`: it wraps one optimiser only.
        wrapped = self.optimizers()
        (wrapped[0] if isinstance(wrapped, list) else wrapped).step()
        for optimizer in others:
            optimizer.step()
        for name in PARAMETERS:
            getattr(splat, name).grad = None
        self.densification.after_step(step, output.screen)
        if len(splat) == 0:
            raise ValueError(
                f"No Gaussian is left at step {step}: lower `densification.prune_opacity`, or the weights of the "
                "losses that make Gaussians fade."
            )
        if step % self.log_every == 0 or step + 1 == self.trainer.max_steps:
            self._log_step(loss.detach(), terms, output.color.detach(), target)
        return loss.detach()

    def _target(self, batch: Mapping[str, Any], train: bool) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Photo over the background, its alpha (H, W, 1), and that background, None where it is black."""
        image, alpha = batch["image"], batch.get("alpha")
        background = self.fixed_background
        if alpha is None:
            return image, None, None if self._black else background
        if train and self.random_background:
            background = torch.rand(3).to(image.device, non_blocking=True)
        return image * alpha + (1.0 - alpha) * background, alpha, background

    def _log_step(self, loss: Tensor, terms: Mapping[str, Tensor], image: Tensor, target: Tensor) -> None:
        psnr = peak_signal_noise_ratio(image.clamp(0.0, 1.0), target, data_range=1.0)
        self.log("psnr", psnr, prog_bar=True, logger=False)
        self.log("gaussians", float(len(self.splat)), prog_bar=True, logger=False)
        values: dict[str, Any] = {"loss": loss, "psnr": psnr, "gaussians": len(self.splat)} | dict(terms)
        values["rate_means"] = self._raw_optimizers()[0].param_groups[0]["lr"]
        for logger in self.trainer.loggers:  # not self.log, which would write them again at every step
            logger.log_metrics({f"train/{name}": float(value) for name, value in values.items()}, self.global_step)

    # ---- what is not finite

    def _check_pending(self) -> None:
        """Raise if the last loss was not finite: on a GPU one step later, so that nothing waits for it."""
        step = None if self._pending is None else self._pending.step
        if self._pending is not None and step is not None and not math.isfinite(self._pending.take()):
            raise TrainingDiverged(step, "the loss", self.last_checkpoint())

    def last_checkpoint(self) -> str | None:
        """The newest checkpoint of this training, or the one that it continues; None if there is none."""
        folders = [getattr(callback, "dirpath", None) for callback in self.trainer.checkpoint_callbacks]
        files = [file for folder in folders if folder for file in Path(folder).glob("*.ckpt")]
        files = [file for file in files if file.stat().st_mtime_ns >= self._begun - _CLOCK_STEP]  # of this run
        if files:
            return str(max(files, key=lambda file: file.stat().st_mtime_ns))
        return None if self.trainer.ckpt_path is None else str(self.trainer.ckpt_path)

    # ---- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the state of the densification; refuse to write Gaussians that are not finite."""
        self._check_pending()
        for name in PARAMETERS:
            if not bool(torch.isfinite(getattr(self.splat, name)).all()):
                raise TrainingDiverged(self.global_step, f"a value of `{name}`", self.last_checkpoint())
        checkpoint["splat_training"] = {
            "densification": self.densification.state_dict(),
            "kind": type(self.densification).__name__,
            "scene_scale": self.scene_scale,
            "sh_degree": self.sh_degree,
            "seed": self.seed,
            "random": self._random,
            "seen": self.global_step,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Give the model as many Gaussians as the checkpoint has, before Lightning loads them."""
        stored = checkpoint.get("splat_training")
        if stored is None:
            raise ValueError("The checkpoint holds no Gaussians: it was not written by this training.")
        if stored["sh_degree"] != self.sh_degree:
            raise ValueError(
                f"The checkpoint was trained with `sh_degree` {stored['sh_degree']}, but the configuration says "
                f"{self.sh_degree}: give the same."
            )
        state = {name: checkpoint["state_dict"][f"model.{name}"] for name in PARAMETERS}
        device = self.device if self.model is None else self.model.means.device
        cloud = GaussianCloud(
            state["means"],
            state["quats"],
            state["scales"],
            state["opacities"],
            torch.cat([state["sh0"], state["shN"]], 1),
        )
        self.model = GaussianSurfaceModel.from_cloud(cloud).to(device)
        self.scene_scale, self.seed = stored["scene_scale"], stored["seed"]
        self._random = {name: state.cpu() for name, state in stored["random"].items()}
        self._seen = int(stored["seen"])
        if stored["kind"] == type(self.densification).__name__:
            self.densification.load_state_dict(stored["densification"])
        else:
            warnings.warn(
                f"The checkpoint was trained with {stored['kind']}, so its state is not taken over.", stacklevel=2
            )

    # ---- evaluation

    def on_validation_epoch_start(self) -> None:
        """Start the metrics anew."""
        if self._lpips_net is not None:
            metric = lpips_metric(self._lpips_net)
            self._lpips_net = None
            self._lpips = [] if metric is None else [metric]
        self._metrics = {}

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Metrics of one image, and its panel."""
        self._evaluate(batch, batch_idx, "val")

    def on_validation_epoch_end(self) -> None:
        """Log the means over the images."""
        self._log_metrics("val")

    def on_test_epoch_start(self) -> None:
        """Start the metrics anew."""
        self.on_validation_epoch_start()

    def test_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Metrics of one image, and its panel."""
        self._evaluate(batch, batch_idx, "test")

    def on_test_epoch_end(self) -> None:
        """Log the means over the images."""
        self._log_metrics("test")

    def _evaluate(self, batch: Mapping[str, Any], batch_idx: int, stage: str) -> None:
        target, _, background = self._target(batch, train=False)
        fitting = self.trainer.state.fn == "fit"
        degree = self.active_degree(max(self.global_step - 1, 0)) if fitting else self._degree_reached()
        image = self.render(batch["camera"], background, degree).color.clamp(0.0, 1.0)
        one, two = (rearrange(picture, "h w c -> 1 c h w").float() for picture in (image, target))
        values = {"psnr": peak_signal_noise_ratio(one, two, data_range=1.0)}
        if min(image.shape[:2]) >= SSIM_TAPS:
            ssim = structural_similarity_index_measure(one, two, data_range=1.0)
            assert isinstance(ssim, Tensor)
            values["ssim"] = ssim
        if self._lpips and min(image.shape[:2]) >= LPIPS_SIDE:
            values["lpips"] = self._lpips[0].to(self.device)(one, two)
        for name, value in values.items():
            self._metrics.setdefault(name, []).append(value)
        if batch_idx < self.panels and not self.trainer.sanity_checking:
            step = self.global_step if fitting else self._seen
            self._write_panel(batch, target, image, f"{stage}_{batch_idx:02d}", step)

    def _log_metrics(self, stage: str) -> None:
        for name, values in self._metrics.items():
            self.log(f"{stage}/{name}", torch.stack(values).mean(), prog_bar=name == "psnr")
        self.log(f"{stage}/gaussians", float(len(self.splat)))

    def _degree_reached(self) -> int:
        """Degree in use when the checkpoint was written; all of it without one."""
        return self.sh_degree if self._seen == 0 else self.active_degree(self._seen - 1)

    def _write_panel(self, batch: Mapping[str, Any], target: Tensor, image: Tensor, name: str, step: int) -> None:
        from imageio.v3 import imwrite

        pictures = panel(self.splat, self._drawing(), batch["camera"], target, image)
        folder = self.folder / "panels"
        folder.mkdir(parents=True, exist_ok=True)
        pixels = (pictures * 255.0).round().clamp(0, 255).to(torch.uint8).cpu()
        imwrite(folder / f"{name}_{step:06d}.png", pixels.numpy())
        for logger in self.trainer.loggers:
            board: Any = getattr(logger, "experiment", None)
            if hasattr(board, "add_image"):
                board.add_image(name, pixels.numpy(), step, dataformats="HWC")

    # ---- the end

    @property
    def folder(self) -> Path:
        """Folder of what is written."""
        return Path(self.output if self.output is not None else self.trainer.default_root_dir)

    def on_train_end(self) -> None:
        """Check the last loss and write ``point_cloud.ply``."""
        self._check_pending()
        self.export(self.folder / "point_cloud.ply")

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the Gaussians as a 3DGS file, without those that are not finite.

        Args:
            path: File to write; its folder is made.

        Raises:
            ValueError: If none is finite.
        """
        cloud = self.splat.to_cloud()
        values = (cloud.means, cloud.quats, cloud.scales, cloud.opacities[:, None], cloud.sh.flatten(1))
        finite = torch.cat(values, dim=1).isfinite().all(-1)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        GaussianSurfaceModel.from_cloud(cloud.select(finite), requires_grad=False).save_ply(path)
