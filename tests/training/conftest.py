import lightning
import pytest
import torch
from shared import seeded
from torch.utils.data import DataLoader, Dataset

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.torch_renderer import TorchRenderer
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.training.data.datamodule import EndlessShuffle
from gaussian_swaying.training.initial import gaussians_from_points


class Pictures(Dataset):
    """Views of a flag, with alpha."""

    def __init__(self, count, width, height, first=0.0):
        model = GaussianSurfaceModel.from_cloud(FlagScene(spacing=0.05).generate(), requires_grad=False)
        self.views = []
        for index in range(count):
            x = 0.6 + 1.2 * (index - 0.5 * count + first) / count
            camera = look_at_camera((x, -1.8, 0.5), (0.6, 0.0, 0.4), (0.0, 0.0, 1.0), 40.0, width, height)
            colors = model.colors(model.means - camera.position)
            drawn = TorchRenderer()(model.means, model.covariance(), model.opacity(), colors, camera)
            image = drawn.color / drawn.alpha.clamp_min(1e-6)
            view = {"image": image.clamp(0, 1), "alpha": drawn.alpha, "camera": camera, "name": f"{index:03d}"}
            self.views.append(view | {"index": index})

    def __len__(self):
        return len(self.views)

    def __getitem__(self, index):
        return self.views[index]


class FlagData(lightning.LightningDataModule):
    """What SplatTrainer expects of data, without files."""

    scene_scale = 1.5

    def __init__(self, views=6, width=48, height=32, points=150):
        super().__init__()
        self.train, self.held_out = Pictures(views, width, height), Pictures(2, width, height, 0.37)
        self.points = points

    def initial_cloud(self, sh_degree):
        generator = seeded(3)
        points = torch.rand(self.points, 3, generator=generator) * torch.tensor([1.2, 0.1, 0.8])
        points -= torch.tensor([0.0, 0.05, 0.0])
        return gaussians_from_points(points, torch.full((self.points, 3), 0.5), sh_degree)

    def train_dataloader(self):
        order = EndlessShuffle(len(self.train), seed=0, start=self.trainer.global_step)
        return DataLoader(self.train, batch_size=None, sampler=order)

    def val_dataloader(self):
        return DataLoader(self.held_out, batch_size=None)

    test_dataloader = val_dataloader


@pytest.fixture
def data():
    return FlagData()


@pytest.fixture
def make_trainer(tmp_path):
    """A Lightning trainer that writes below a folder of the test and prints nothing."""

    def make(max_steps, folder="run", **options):
        options = {
            "logger": False,
            "enable_checkpointing": False,
            "limit_val_batches": 0,
            "check_val_every_n_epoch": None,
            "enable_progress_bar": False,
            "accelerator": "cpu",
        } | options
        return lightning.Trainer(
            max_steps=max_steps,
            max_epochs=-1,
            default_root_dir=tmp_path / folder,
            enable_model_summary=False,
            **options,
        )

    return make
