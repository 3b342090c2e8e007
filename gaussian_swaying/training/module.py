"""Training of surface-aligned Gaussians as a Lightning module."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.origin import NO_ORIGIN
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.planes import SurfaceMaps, plane_channels, surface_maps
from gaussian_swaying.rendering.protocol import SplatOutput, SplatRenderer
from gaussian_swaying.training.densification import PARAMETERS, DefaultDensification, Densification
from gaussian_swaying.training.initial import gaussians_from_file
from gaussian_swaying.training.losses import LossInputs, LossTerm, OtherView, TotalLoss
from gaussian_swaying.training.optimizers import GaussianAdam, LearningRates, means_rate
from gaussian_swaying.training.panels import panel, picture_metrics, write_panel
from gaussian_swaying.training.parallel import share_gradients, steps_of
from gaussian_swaying.training.surface_losses import SurfaceTerm as SurfaceTerm  # so that a YAML finds its terms


class SplatParallel(DDPStrategy):
    """Lightning's DDP without its wrapper, which would keep the Gaussians of the start: densification replaces them."""

    def configure_ddp(self) -> None:
        """Nothing is wrapped."""


class TrainingDiverged(RuntimeError):  # noqa: N818
    """A loss or a Gaussian is no longer finite after so many images; the last checkpoint, if any, is named."""

    def __init__(self, step: int, what: str, checkpoint: str | None = None) -> None:
        self.step, self.checkpoint = step, checkpoint
        kept = f"the last good checkpoint is {checkpoint}" if checkpoint else "there is no checkpoint yet"
        super().__init__(
            f"Training diverged at step {step}: {what} is not finite; {kept}. Remedy: lower the learning rates "
            "(`model.rates`) or the weight of the loss that grew (`model.loss_weights`)."
        )


class SplatTrainer(lightning.LightningModule):
    """Trains a :class:`~gaussian_swaying.gaussians.model.GaussianSurfaceModel` on photos with known cameras.

    A step is one image. On several devices a step of Lightning takes one image on each, see
    :mod:`~gaussian_swaying.training.parallel`: then the trainer's ``max_steps`` and intervals count its steps, and all
    that is given here in steps still counts images. Random numbers of a step follow from the seed and its number, so
    that a resumed run continues exactly.

    Batches have items ``image`` (H, W, 3), ``alpha`` (H, W, 1) or None, ``camera`` and ``name``. If there is an alpha,
    the colours of the image are not premultiplied. Losses that compare two views also need the item ``index``, and
    ``datamodule.other_view(index, pick)``. The initial Gaussians come from ``init_ply``, or else from
    ``datamodule.initial_cloud(sh_degree)``, and the extent of the scene from ``datamodule.scene_scale``.

    Args:
        loss_weights: Weights of the losses by name (``rgb``, ``anisotropy``, ``entropy``, ``size`` and further terms),
            in place of the paper's, see :class:`~gaussian_swaying.training.losses.TotalLoss`; 0 leaves one out.
        loss_terms: Further losses by name, or others in place of those four.
        densification: Strategy that copies, splits and removes Gaussians.
        rates: Learning rates.
        sh_degree: Highest degree of the spherical harmonics, 0 to 3.
        sh_every: Steps after which the degree in use rises by one; 0 for all from the start.
        background: Colour behind the Gaussians: ``random`` (a new one in each step for photos with alpha, else black),
            ``black``, ``white``, or a colour from 0 to 1.
        scene_scale: Extent of the scene [scene units], to which learning rates and thresholds are relative; by default
            that of the cameras (``datamodule.scene_scale``).
        seed: Seed of backgrounds and new Gaussians.
        panels: Number of validation images written as panels of photo, render, normals and area.
        log_every: Steps between logged values.
        init_ply: Splat with the initial Gaussians.

    Attributes:
        renderer: The renderer; None for that of :func:`~gaussian_swaying.rendering.gsplat_renderer.make_renderer`.

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
        init_ply: str | None = None,
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
        self.init_ply = init_ply
        self.model: GaussianSurfaceModel | None = None
        self.renderer = None
        self._made: dict[str, SplatRenderer] = {}  # by kind of device: Lightning moves the model after a fit
        self._fitting = False
        self._seen = 0  # number of images that the checkpoint was trained on
        self._saved: str | None = None  # the last checkpoint

    fixed_background: Tensor

    @property
    def splat(self) -> GaussianSurfaceModel:
        """The Gaussians; RuntimeError before there are any."""
        if self.model is None:
            raise RuntimeError("There are no Gaussians yet: they are made when training starts.")
        return self.model

    def setup(self, stage: str) -> None:
        """Make the initial Gaussians, unless they come from a checkpoint."""
        datamodule: Any = getattr(self.trainer, "datamodule", None)
        self._fitting = stage == "fit"
        if self.scene_scale is None:
            self.scene_scale = float(getattr(datamodule, "scene_scale", 1.0))
            check_positive("scene_scale", self.scene_scale)
        if self.model is None:
            if self.init_ply is not None:
                cloud = gaussians_from_file(self.init_ply, self.sh_degree)
            elif hasattr(datamodule, "initial_cloud"):
                cloud = datamodule.initial_cloud(self.sh_degree)
            else:
                raise ValueError("Expected initial Gaussians: set `init_ply`, or use data with points.")
            self.model = GaussianSurfaceModel.from_cloud(cloud.rebased(getattr(datamodule, "origin", NO_ORIGIN)))
        # normals of a file cannot follow splits
        self.model.reference_normals = None

    def configure_optimizers(self) -> GaussianAdam:
        """The optimiser, with a group for each of :data:`PARAMETERS`."""
        assert self.scene_scale is not None
        rates = vars(self.rates) | {"means": self.rates.means * self.scene_scale}
        parameters = [getattr(self.splat, name) for name in PARAMETERS]
        return GaussianAdam(parameters, [rates[name] for name in PARAMETERS], self.devices)

    def on_fit_start(self) -> None:
        """Refuse settings that would silently train wrongly."""
        if self.devices > 1 and not isinstance(self.trainer.strategy, SplatParallel):
            raise ValueError(
                "Expected `trainer.strategy` to be auto, or SplatParallel in Python, for several devices, but got "
                f"{type(self.trainer.strategy).__name__}: Lightning's own ones keep the Gaussians of the start."
            )
        if self.trainer.precision not in ("32-true", "32"):
            raise ValueError(
                f"Expected `trainer.precision` to be 32-true, but got {self.trainer.precision}: splats need float32."
            )

    def on_train_start(self) -> None:
        """Attach the Gaussians and their optimiser to the densification, after a checkpoint has been read."""
        assert self.scene_scale is not None
        self.densification.attach(self.splat, self.trainer.optimizers[0], self.scene_scale, self.devices)

    @property
    def devices(self) -> int:
        """Number of devices that train together; a step takes so many images."""
        return self.trainer.world_size

    def active_degree(self, step: int) -> int:
        """Degree of the harmonics in use at a step."""
        return self.sh_degree if self.sh_every == 0 else min(step // self.sh_every, self.sh_degree)

    def render(
        self, camera: Camera, background: Tensor | None = None, degree: int | None = None, surface: bool = False
    ) -> SplatOutput:
        """Draw the Gaussians over a colour (3,), black if None, with some ``degree`` of the harmonics, all if None.

        With ``surface``, also the channels that :func:`~gaussian_swaying.rendering.planes.surface_maps` needs.
        """
        splat = self.splat
        degree = self.sh_degree if degree is None else degree
        sh = torch.cat([splat.sh0, splat.shN[:, : (degree + 1) ** 2 - 1]], dim=1) if degree else splat.sh0
        channels = None
        if surface:
            view = camera.to(splat.means.device, splat.means.dtype)
            channels = plane_channels(splat.means, splat.quats, splat.scales, view)
        return self._drawing().render_splat(
            splat.means, splat.quats, splat.scales, splat.opacity(), sh, camera, background, channels
        )

    def _drawing(self) -> SplatRenderer:
        if self.renderer is not None:
            return self.renderer
        device = self.splat.means.device
        if device.type not in self._made:
            self._made[device.type] = make_renderer(device)
        return self._made[device.type]

    def training_step(self, batch: Mapping[str, Any]) -> Tensor:
        """Train on an image: picture, losses, gradients, step of the optimiser, densification."""
        step = self.global_step
        optimizer: Any = self.optimizers()  # Lightning's wrapper, whose step counts
        assert self.scene_scale is not None
        steps, images = int(self.trainer.max_steps), step * self.devices  # images before this step
        self._seed(step, self.global_rank)  # other backgrounds on each device
        optimizer.param_groups[0]["lr"] = means_rate(self.rates, self.scene_scale, step, steps, self.devices)
        target, alpha, background = self._target(batch, train=True)
        needs = self.loss.needs(images)
        output = self.render(batch["camera"], background, self.active_degree(images), bool(needs))
        splat = self.splat
        camera, surface = self._surface(output, batch["camera"]) if needs else (None, None)
        inputs = LossInputs(
            output.color,
            target,
            output.alpha,
            alpha,
            splat.means,
            splat.quats,
            splat.scales,
            splat.opacity(),
            images,
            camera,
            surface,
            self._other_view(batch, background) if "other_view" in needs else None,
        )
        loss, terms = self.loss(inputs)
        if not loss.requires_grad:  # no Gaussian in the picture, and the loss depends only on the picture
            loss = loss + 0.0 * splat.means.sum()
        self.densification.before_backward(step, output.screen)
        self.manual_backward(loss)
        mean = loss.detach()
        if self.devices > 1:
            mean = share_gradients([getattr(splat, name) for name in PARAMETERS], loss)
            self._seed(step, 0)  # the same changes on all devices
        logs = step % steps_of(self.log_every, self.devices) == 0 or step + 1 == steps
        if (logs or self.device.type != "cuda") and not math.isfinite(mean):  # a GPU would wait for it
            raise TrainingDiverged(images, "the loss", self.last_checkpoint())
        optimizer.step()
        splat.zero_grad()
        self.densification.after_step(step, output.screen)
        if len(splat) == 0:
            raise ValueError(
                f"No Gaussian is left at step {images}: lower `densification.prune_opacity`, or the weights of the "
                "losses that lower opacities."
            )
        if logs:
            self._log_step(loss.detach(), terms, output.color.detach(), target)
        return loss.detach()

    def _seed(self, step: int, rank: int) -> None:
        seed = ((self.seed * 1_000_003 + step) * 1_009 + rank) % 2**63
        torch.default_generator.manual_seed(seed)  # torch.manual_seed also queues a call with its stack, for good, for
        if self.device.type == "cuda":  # each kind of device that this process does not use
            torch.cuda.manual_seed(seed)

    def _surface(self, output: SplatOutput, camera: Camera) -> tuple[Camera, SurfaceMaps]:
        assert output.channels is not None
        camera = camera.to(output.channels.device, output.channels.dtype)
        return camera, surface_maps(output.channels, output.alpha, camera)

    def _other_view(self, batch: Mapping[str, Any], background: Tensor | None) -> OtherView | None:
        datamodule: Any = getattr(self.trainer, "datamodule", None)
        if not hasattr(datamodule, "other_view"):
            raise ValueError(
                "Expected a datamodule with `other_view(index, pick)`, as a loss compares two views: use "
                "CaptureDataModule, or set the weights of the multi-view losses to 0."
            )
        other = datamodule.other_view(batch["index"], float(torch.rand(())))
        if other is None:
            return None
        other = other.to(self.device) if hasattr(other, "to") else other
        image, alpha = other["image"], other.get("alpha")
        image = image.to(self.device)
        if alpha is not None:
            alpha = alpha.to(self.device)
            image = image * alpha + (1.0 - alpha) * (self.fixed_background if background is None else background)
        with torch.no_grad():
            camera, surface = self._surface(self.render(other["camera"], degree=0, surface=True), other["camera"])
        return OtherView(image, camera, surface)

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
        self.log("psnr", psnr, prog_bar=True, logger=False, batch_size=1)
        self.log("gaussians", float(len(self.splat)), prog_bar=True, logger=False, batch_size=1)
        values: dict[str, Any] = {"loss": loss, "psnr": psnr, "gaussians": len(self.splat)} | dict(terms)
        values["rate_means"] = self.trainer.optimizers[0].param_groups[0]["lr"]
        for logger in self.trainer.loggers:  # not self.log, which would write them again at every step
            logger.log_metrics({f"train/{name}": float(value) for name, value in values.items()}, self.global_step)

    def last_checkpoint(self) -> str | None:
        """The newest checkpoint of this run, or the one that it resumes; None if there is none."""
        resumed = self.trainer.ckpt_path
        return self._saved or (None if resumed is None else str(resumed))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the state of the densification; refuse to write Gaussians that are not finite."""
        for name in PARAMETERS:
            if not bool(torch.isfinite(getattr(self.splat, name)).all()):
                raise TrainingDiverged(self.global_step * self.devices, f"a value of `{name}`", self.last_checkpoint())
        kept: Any = self.trainer.checkpoint_callback
        self._saved = getattr(kept, "best_model_path", None) or self._saved
        checkpoint["splat_training"] = {
            "devices": self.devices,
            "densification": self.densification.state_dict(),
            "kind": type(self.densification).__name__,
            "scene_scale": self.scene_scale,
            "sh_degree": self.sh_degree,
            "seed": self.seed,
            "origin": self.splat.origin,
            "seen": self.global_step * self.devices,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Make a model with as many Gaussians as the checkpoint, before Lightning loads them."""
        stored = checkpoint.get("splat_training")
        if stored is None:
            raise ValueError("The checkpoint has no Gaussians: it was not written by this package.")
        known = stored.get("devices", 1)
        if stored["sh_degree"] != self.sh_degree:
            raise ValueError(
                f"The checkpoint was trained with `sh_degree` {stored['sh_degree']}, but the configuration says "
                f"{self.sh_degree}: use the same."
            )
        if self._fitting and known != self.devices:
            raise ValueError(
                f"The checkpoint was trained on {known} devices, but there are {self.devices}: use `trainer.devices: "
                f"{known}`."
            )
        if self._fitting and len(checkpoint["optimizer_states"]) != 1:
            raise ValueError(
                "The checkpoint is from an earlier version, with an optimiser for each parameter, so it cannot be "
                "continued: start a new run, from its splat with `init_ply`."
            )
        device = self.device if self.model is None else self.model.means.device
        means, scales, quats, opacities, sh0, rest = (checkpoint["state_dict"][f"model.{name}"] for name in PARAMETERS)
        origin = stored.get("origin", NO_ORIGIN)
        cloud = GaussianCloud(means, quats, scales, opacities, torch.cat([sh0, rest], 1), origin=origin)
        self.model = GaussianSurfaceModel.from_cloud(cloud).to(device)
        self.scene_scale, self.seed = stored["scene_scale"], stored["seed"]
        self._seen = int(stored["seen"])
        if stored["kind"] == type(self.densification).__name__:
            self.densification.load_state_dict(stored["densification"])
        else:
            warnings.warn(f"The checkpoint was trained with {stored['kind']}, so its state is not used.", stacklevel=2)

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        self._evaluate(batch, batch_idx, "val")

    def test_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        self._evaluate(batch, batch_idx, "test")

    def _evaluate(self, batch: Mapping[str, Any], batch_idx: int, stage: str) -> None:
        target, _, background = self._target(batch, train=False)
        images = self.global_step * self.devices if self._fitting else self._seen
        degree = self.active_degree(max(images - 1, 0)) if self._fitting or images else self.sh_degree
        image = self.render(batch["camera"], background, degree).color.clamp(0.0, 1.0)
        for name, value in picture_metrics(image, target).items():
            self.log(f"{stage}/{name}", value, prog_bar=name == "psnr", batch_size=1)
        self.log(f"{stage}/gaussians", float(len(self.splat)), batch_size=1)
        if batch_idx < self.panels and not self.trainer.sanity_checking and self.trainer.is_global_zero:
            pictures = panel(self.splat, self._drawing(), batch["camera"], target, image)
            folder = Path(self.trainer.default_root_dir) / "panels"
            write_panel(pictures, folder, f"{stage}_{batch_idx:02d}", images, self.trainer.loggers)

    def on_train_end(self) -> None:
        """Write ``point_cloud.ply``."""
        if self.trainer.is_global_zero:
            self.export(Path(self.trainer.default_root_dir) / "point_cloud.ply")

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the Gaussians as a 3DGS file, without those that are not finite; ValueError if none is."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        cloud = self.splat.to_cloud()
        values = (cloud.means, cloud.quats, cloud.scales, cloud.opacities[:, None], cloud.sh.flatten(1))
        finite = cloud.select(torch.cat(values, dim=1).isfinite().all(-1))
        GaussianSurfaceModel.from_cloud(finite, requires_grad=False).save_ply(path)
