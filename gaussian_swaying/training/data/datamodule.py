"""The views of a capture as training images, one per batch, for Lightning."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Literal

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from gaussian_swaying._checks import check_positive
from gaussian_swaying.captures.capture import Capture, View, neighbouring_views, read_capture
from gaussian_swaying.captures.images import straight_colors
from gaussian_swaying.captures.initial_points import initial_points
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.origin import Origin
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.training.initial import gaussians_from_points
from gaussian_swaying.training.parallel import this_device


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImage:
    """One batch: the bytes of an image, (H, W, 3), or (H, W, 4) with premultiplied alpha, and the camera that took it.

    ``index`` is that of the view in ``Capture.split(...)``. Fields and properties are also items: ``batch["image"]``.
    """

    pixels: Tensor
    camera: Camera
    name: str
    index: int
    _cameras: dict[torch.device, Camera] = field(default_factory=dict, repr=False)  # by device, cached by the dataset

    @property
    def image(self) -> Tensor:
        """Colours in 0 to 1, without premultiplied alpha, float32, shape (H, W, 3)."""
        return straight_colors(self.pixels)[0]

    @property
    def alpha(self) -> Tensor | None:
        """Alpha in 0 to 1, float32, shape (H, W, 1), or None if the image is opaque."""
        return straight_colors(self.pixels)[1]

    def __getitem__(self, name: str) -> Any:
        if name not in ("image", "alpha", "pixels", "camera", "name", "index"):
            raise KeyError(name)
        return getattr(self, name)

    def get(self, name: str, default: Any = None) -> Any:
        try:
            return self[name]
        except KeyError:
            return default

    def to(self, device: torch.device | str, non_blocking: bool = False) -> TrainingImage:
        device = torch.device(device)
        if device not in self._cameras:
            self._cameras[device] = self.camera.to(device)
        pixels = self.pixels.to(device, non_blocking=non_blocking or self.pixels.is_pinned())
        return replace(self, pixels=pixels, camera=self._cameras[device])

    def pin_memory(self) -> TrainingImage:
        return replace(self, pixels=self.pixels.pin_memory())


class CaptureDataset(Dataset[TrainingImage]):
    """Views of one split; some threads read them into a cache of bytes, page-locked if there is a GPU."""

    def __init__(self, views: tuple[View, ...], cache: bool = True, threads: int = 4) -> None:
        self.views = views
        self._cameras: list[dict[torch.device, Camera]] = [{} for _ in views]
        self._pixels: list[Tensor] | None = None
        if cache:
            with ThreadPoolExecutor(max(threads, 1)) as pool:
                self._pixels = list(pool.map(View.load, views))
            if torch.cuda.is_available():
                self._pixels = [pixels.pin_memory() for pixels in self._pixels]

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> TrainingImage:
        view = self.views[index]
        pixels = view.load() if self._pixels is None else self._pixels[index]
        return TrainingImage(pixels, view.camera, view.name, index, self._cameras[index])


class CaptureDataModule(LightningDataModule):
    """Training, validation and test images of a capture.

    A batch is one :class:`TrainingImage`. Training images are endless: they come in rounds whose order depends only on
    ``seed``. A run resumed from a checkpoint continues with the next image; one image is one step of the trainer.
    Validation and test images are sorted by name. Validation uses the split ``val`` of the capture, or ``test`` if
    there is none. Alpha is passed on, as the trainer chooses the background.

    Args:
        path: Folder or transforms.json, see :func:`~gaussian_swaying.captures.capture.read_capture`.
        format: ``auto``, ``colmap`` or ``transforms``.
        downscale: Factor by which width and height are reduced.
        test_every: Every n-th image is for testing, 0 for none; not used if the files define the splits.
        images: Folder of the images of a COLMAP model.
        workers: With ``cache`` the number of threads that read the images at the start of the run; without it the
            number of processes that read them when needed.
        cache: Keep the images in memory, as bytes in the size used for training.
        points: Initial points of the Gaussians, see :func:`~gaussian_swaying.captures.initial_points.initial_points`.
        point_count: Number of points, where they are drawn at random.
        seed: Seed of the order and of random points; by default that of ``seed_everything``, or 0.
        initial_opacity: Opacity of the Gaussians at these points, between 0 and 1; 0.5 suits MCMC.
        initial_scale: Their standard deviation as a multiple of the distance to their neighbours, 0.001 to 100; 0.1
            suits MCMC.
        other_views: For losses that compare two views: how many others of each are used, see
            :func:`~gaussian_swaying.captures.capture.neighbouring_views`.
        other_view_angle: Largest angle between the optical axes of the two [degrees].

    Raises:
        ValueError: If an argument is out of range; in ``setup``, if the capture is bad.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        format: Literal["auto", "colmap", "transforms"] = "auto",
        *,
        downscale: int = 1,
        test_every: int = 8,
        images: str = "images",
        workers: int = 4,
        cache: bool = True,
        points: str = "auto",
        point_count: int = 100_000,
        seed: int | None = None,
        initial_opacity: float = 0.1,
        initial_scale: float = 1.0,
        other_views: int = 8,
        other_view_angle: float = 30.0,
    ) -> None:
        super().__init__()
        check_positive("other_views", other_views)
        check_positive("other_view_angle", other_view_angle)
        self.other_views, self.other_view_angle = int(other_views), float(other_view_angle)
        self._others: list[list[int]] | None = None
        if not 0.0 < initial_opacity < 1.0:
            raise ValueError(f"Expected `initial_opacity` between 0 and 1 (both excluded), but got {initial_opacity}.")
        if not 1e-3 <= initial_scale <= 100:
            raise ValueError(
                f"Expected `initial_scale` from 0.001 to 100, but got {initial_scale:g}: with 1 a Gaussian is as large "
                "as the distance to its neighbours."
            )
        self.initial_opacity, self.initial_scale = initial_opacity, initial_scale
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 0:
            raise ValueError(f"Expected `workers` to be a whole number of at least 0, but got {workers!r}.")
        self.path, self.format, self.downscale, self.test_every = path, format, downscale, test_every
        self.images, self.workers, self.cache = images, workers, cache
        self.points, self.point_count = points, point_count
        self.seed = int(os.environ.get("PL_GLOBAL_SEED", "0")) if seed is None else seed
        self._capture: Capture | None = None
        self._datasets: dict[str, CaptureDataset] = {}

    @property
    def capture(self) -> Capture:
        """The capture, read at the first access."""
        if self._capture is None:
            self._capture = read_capture(
                self.path, self.format, downscale=self.downscale, test_every=self.test_every, images=self.images
            )
        return self._capture

    @property
    def scene_scale(self) -> float:
        return self.capture.extent

    @property
    def origin(self) -> Origin:
        return self.capture.origin

    def initial_cloud(self, sh_degree: int = 3) -> GaussianCloud:
        """The initial Gaussians; ValueError if this capture cannot provide ``points``."""
        cloud = initial_points(self.capture, self.points, self.point_count, self.seed)
        settings = (sh_degree, self.initial_opacity, self.initial_scale)
        return replace(gaussians_from_points(cloud.points, cloud.colors, *settings), origin=self.origin)

    @property
    def validation_split(self) -> str:
        """``val`` if the capture has such a split, else ``test``."""
        return "val" if self.capture.split("val") else "test"

    def setup(self, stage: str | None = None) -> None:
        """Read the capture, and the images of the stage into the cache; ValueError if they are bad."""
        if self.trainer is None or self.trainer.is_global_zero:
            print(self.capture.found)
        wanted = {"fit": ("train", self.validation_split), "validate": (self.validation_split,), "test": ("test",)}
        for split in wanted.get(stage or "", ("train", self.validation_split, "test")):
            if stage in ("validate", "test") and not self.capture.split(split):
                raise ValueError(
                    f"The split `{split}` of {self.path} is empty, so there is nothing to {stage}: set `test_every`, "
                    "or list the images in the capture's files."
                )
            self._dataset(split)

    def _dataset(self, split: str) -> CaptureDataset:
        if split not in self._datasets:
            self._datasets[split] = CaptureDataset(self.capture.split(split), self.cache, self.workers)
        return self._datasets[split]

    def _options(self) -> dict[str, Any]:
        workers, pin = 0 if self.cache else self.workers, torch.cuda.is_available() and not self.cache
        return {"batch_size": None, "num_workers": workers, "persistent_workers": workers > 0, "pin_memory": pin}

    def transfer_batch_to_device(
        self, batch: TrainingImage, device: torch.device, dataloader_idx: int
    ) -> TrainingImage:
        """The image on the device; Lightning would search its fields at every step."""
        return batch.to(device, non_blocking=True)

    def train_dataloader(self) -> DataLoader[TrainingImage]:
        dataset = self._dataset("train")
        rank, devices = this_device()
        seen = 0 if self.trainer is None else self.trainer.global_step * devices
        order = EndlessShuffle(len(dataset), self.seed, seen + rank, devices)
        return DataLoader(dataset, sampler=order, **self._options())

    def state_dict(self) -> dict[str, int]:
        """The settings that define the order of training images; Lightning stores them in checkpoints."""
        return {"seed": self.seed, "count": len(self.capture.split("train"))}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Refuse a checkpoint of another seed or number of training images."""
        now, fitting = self.state_dict(), self.trainer is None or self.trainer.state.fn == "fit"
        for name, what in (("seed", "seed"), ("count", "number of training images")):
            if fitting and state_dict[name] != now[name]:
                raise ValueError(
                    f"The {what} of {self.path} was {state_dict[name]} in the checkpoint and is {now[name]} now: set "
                    "the old value, or start a new run."
                )

    def other_view(self, index: int, pick: float) -> TrainingImage | None:
        """A training image of the same place as another one, ``pick`` of its neighbours, 0 to 1; None if none."""
        dataset = self._dataset("train")
        if self._others is None:
            cameras = [view.camera for view in dataset.views]
            self._others = neighbouring_views(cameras, self.other_views, self.other_view_angle)
        others = self._others[index]
        return dataset[others[int(pick * len(others))]] if others else None

    def val_dataloader(self) -> DataLoader[TrainingImage]:
        return DataLoader(self._dataset(self.validation_split), shuffle=False, **self._options())

    def test_dataloader(self) -> DataLoader[TrainingImage]:
        return DataLoader(self._dataset("test"), shuffle=False, **self._options())


class EndlessShuffle(Sampler[int]):
    """Endless indices of ``count`` images: each round is a permutation given by the seed and the number of the round.

    A run that continues after ``start`` images gets exactly the same images as one without a stop. One of several
    devices takes ``every`` so many of them.

    Raises:
        ValueError: If there is no image, or ``start`` is negative.

    Example:
        >>> from itertools import islice
        >>> list(islice(EndlessShuffle(3, seed=0), 2, 7)) == list(islice(EndlessShuffle(3, seed=0, start=2), 5))
        True
    """

    def __init__(self, count: int, seed: int = 0, start: int = 0, every: int = 1) -> None:
        if count < 1:
            raise ValueError("Expected at least one image to train on, but got none.")
        if start < 0:
            raise ValueError(f"Expected `start` not to be negative, but got {start}.")
        self.count, self.seed, self.start, self.every = count, seed, start, every

    def __iter__(self) -> Iterator[int]:
        return islice(self._all(), 0, None, self.every)

    def _all(self) -> Iterator[int]:
        number, skip = divmod(self.start, self.count)
        while True:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + number)
            yield from torch.randperm(self.count, generator=generator)[skip:].tolist()
            number, skip = number + 1, 0
