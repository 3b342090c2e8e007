"""What a training gets: every image once a round, the same after a restart, nothing but bytes in memory."""

import itertools
import math

import pytest
import torch
from shared import near, value_error
from small_captures import arc, write_transforms
from torch.testing import assert_close

lightning = pytest.importorskip("lightning")

from gaussian_swaying.gaussians.model import GaussianSurfaceModel  # noqa: E402
from gaussian_swaying.rendering.torch_renderer import TorchRenderer  # noqa: E402
from gaussian_swaying.training.data.datamodule import CaptureDataModule  # noqa: E402


@pytest.fixture
def folder(tmp_path):
    names = [f"images/{index:03d}.png" for index in range(9)]
    return write_transforms(tmp_path / "capture", arc(9), names, channels=4)


def _indices(data, count):
    return [batch["index"] for batch in itertools.islice(data.train_dataloader(), count)]


def test_a_batch_is_an_image_with_its_camera(folder):
    data = CaptureDataModule(folder, seed=1)
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))
    view = data.capture.split("train")[batch.index]
    pixels = view.load()
    assert (batch["name"], batch["camera"]) == (view.name, view.camera)
    assert torch.equal(batch["pixels"], pixels)
    assert batch["image"].shape == (16, 20, 3)
    assert batch["alpha"].shape == (16, 20, 1)
    near(batch.image * batch.alpha, pixels[..., :3] / 255, 1e-6)
    assert batch.get("mask") is None
    with pytest.raises(KeyError):
        batch["mask"]
    moved = batch.to("cpu")
    assert torch.equal(moved.pixels, pixels)


@pytest.mark.parametrize("options", [{}, {"cache": False, "workers": 0}, {"cache": False, "workers": 2}])
def test_every_image_once_a_round_and_the_seed_decides(folder, options):
    first, again, other = (CaptureDataModule(folder, seed=seed, **options) for seed in (1, 1, 2))
    order = _indices(first, 14)
    assert sorted(order[:7]) == sorted(order[7:]) == list(range(7))
    assert order[:7] != order[7:]
    assert _indices(again, 14) == order
    assert _indices(other, 14) != order
    assert [batch.name for batch in first.val_dataloader()] == ["images/000.png", "images/008.png"]
    assert [batch.name for batch in first.test_dataloader()] == ["images/000.png", "images/008.png"]


def test_cache_and_workers_give_the_same_pixels(folder):
    pictures = []
    for options in ({"cache": True}, {"cache": False, "workers": 2}):
        data = CaptureDataModule(folder, downscale=2, seed=5, **options)
        pictures.append([batch.pixels for batch in itertools.islice(data.train_dataloader(), 7)])
    assert all(torch.equal(one, two) for one, two in zip(*pictures, strict=True))
    assert pictures[0][0].dtype == torch.uint8
    assert pictures[0][0].shape == (8, 10, 4)


def test_only_the_images_of_the_stage_are_read(folder):
    (folder / "images/003.png").write_bytes((folder / "images/003.png").read_bytes()[:60])  # its header is whole
    data = CaptureDataModule(folder)
    data.setup("test")
    with value_error(r"images/003\.png cannot be read"):
        data.setup("fit")


def test_validation_prefers_its_own_split(tmp_path):
    names = [f"{index}.png" for index in range(4)]
    lists = {"train_filenames": names[:2], "val_filenames": names[2:3], "test_filenames": names[3:]}
    data = CaptureDataModule(write_transforms(tmp_path, arc(4), names, **lists))
    data.setup()
    assert [batch.name for batch in data.val_dataloader()] == ["2.png"]
    assert [batch.name for batch in data.test_dataloader()] == ["3.png"]


class _Watcher(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, batch_idx):
        self.seen.append(batch["name"])
        return self.weight + batch["image"].mean()

    def configure_optimizers(self):
        return torch.optim.SGD([self.weight], lr=0.1)


def _fit(folder, steps, root, checkpoint=None, **options):
    model, data = _Watcher(), CaptureDataModule(folder, seed=3, **options)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        max_epochs=-1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=root,
    )
    trainer.fit(model, data, ckpt_path=checkpoint)
    return trainer, model.seen


@pytest.mark.filterwarnings("ignore::UserWarning")  # Lightning's advice on workers
@pytest.mark.parametrize("stop", [4, 7, 10])
def test_a_resumed_run_sees_the_images_that_come_next(folder, tmp_path, stop):
    _, whole = _fit(folder, 16, tmp_path)
    trainer, first = _fit(folder, stop, tmp_path)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    _, second = _fit(folder, 16, tmp_path, tmp_path / "a.ckpt")
    assert first + second == whole
    assert len(set(whole[:7])) == 7


def test_a_checkpoint_of_other_images_or_another_seed_is_refused(folder):
    state = {"seed": 0, "count": 7}
    data = CaptureDataModule(folder)
    data.load_state_dict(state | {"seen": 5})  # of an earlier version
    assert data.state_dict() == state
    with value_error(r"seed.*was 0.*is 4 now"):
        CaptureDataModule(folder, seed=4).load_state_dict(state)
    with value_error(r"number of training images.*was 7.*is 9 now"):
        CaptureDataModule(folder, test_every=0).load_state_dict(state)


def test_what_a_trainer_starts_from(folder):
    data = CaptureDataModule(folder, point_count=64)
    assert data.scene_scale == data.capture.extent
    cloud = data.initial_cloud(1)
    assert len(cloud) == 64
    assert cloud.sh.shape == (64, 4, 3)
    other = CaptureDataModule(folder, point_count=64, initial_opacity=0.5, initial_scale=0.1).initial_cloud(1)
    assert_close(other.opacities, torch.zeros(64))
    assert_close(other.scales, cloud.scales + math.log(0.1))


def test_a_capture_of_another_unit_looks_the_same(tmp_path):
    pictures = []
    for number, scale in enumerate([1.0, 2.0**-9, 2.0**9]):  # powers of two round alike
        poses = arc(9)
        for pose in poses:
            pose.world_to_camera[:3, 3] *= scale
        data = CaptureDataModule(write_transforms(tmp_path / str(number), poses, [f"{i}.png" for i in range(9)]))
        data.point_count = 300
        model, camera = GaussianSurfaceModel(data.initial_cloud()), data.capture.views[4].camera
        assert camera.near == pytest.approx(0.01 * data.scene_scale)
        with torch.no_grad():
            colors = torch.linspace(0, 1, 900).view(300, 3)
            drawn = TorchRenderer()(model.means, model.covariance(), model.opacity(), colors, camera)
        pictures.append(drawn.color)
    assert pictures[0].std() > 0.01
    for picture in pictures[1:]:
        near(picture, pictures[0], 1e-4)


def test_bad_arguments(folder):
    with value_error("`workers`"):
        CaptureDataModule(folder, workers=-1)
    with value_error("`initial_opacity`"):
        CaptureDataModule(folder, initial_opacity=1.0)
    for scale in (0.0, 1e-30, 1e30, math.nan):
        with value_error(r"`initial_scale` from 0\.001 to 100"):
            CaptureDataModule(folder, initial_scale=scale)
    with value_error("`format`"):
        CaptureDataModule(folder, format="nerf").setup()
