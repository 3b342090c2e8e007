import os
import socket
import subprocess
import sys
from itertools import islice
from pathlib import Path

import lightning
import pytest
import torch
from shared import rows
from torch import distributed, multiprocessing
from torch.utils.data import DataLoader

from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.training.data.datamodule import EndlessShuffle
from gaussian_swaying.training.densification import PARAMETERS, DefaultDensification
from gaussian_swaying.training.module import SplatParallel, SplatTrainer
from gaussian_swaying.training.parallel import scaled_adam, share_gradients, steps_of

TOOL = Path(__file__).parents[2] / "tools/train.py"


def test_each_device_has_its_own_images():
    alone = list(islice(EndlessShuffle(5, seed=2, start=4), 24))
    shares = [list(islice(EndlessShuffle(5, seed=2, start=4 + rank, every=3), 8)) for rank in range(3)]
    assert [image for step in zip(*shares, strict=True) for image in step] == alone


def test_the_schedule_counts_images():
    default = DefaultDensification(start=500, stop=15_000, every=100, reset_every=3000)
    default.devices = 2
    strategy = default.make_strategy(torch.device("cpu"))
    steps = (strategy.refine_start_iter, strategy.refine_stop_iter, strategy.refine_every, strategy.reset_every)
    assert steps == (250, 7500, 50, 1500)
    assert steps_of(7, 2) == 4


def test_the_rates_of_a_step_of_several_images():
    assert scaled_adam(1e-3, 1) == {"lr": 1e-3, "betas": pytest.approx((0.9, 0.999)), "eps": 1e-15}
    four = scaled_adam(1e-3, 4)
    assert four["lr"] == 2e-3
    assert four["betas"] == pytest.approx((0.6, 0.996))
    assert four["eps"] == pytest.approx(5e-16)


def _start(function, *arguments):
    """Two processes; on Linux forks of one that has imported Lightning."""
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    if method == "forkserver":
        multiprocessing.get_context(method).set_forkserver_preload(["lightning", "gaussian_swaying.training.module"])
    multiprocessing.start_processes(function, arguments, nprocs=2, start_method=method)


def _share(rank, address, out):
    distributed.init_process_group("gloo", init_method=f"file://{address}", rank=rank, world_size=2)
    try:
        first, second = torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(2))
        first.grad = torch.tensor([1.0, 2.0, 3.0]) * (rank + 1)
        mean = share_gradients([first, second], torch.tensor(rank + 1.0))
        held = {"mean": mean, "first": first.grad, "second": second.grad}
        torch.save(held, f"{out}/{rank}.pt")
    finally:
        distributed.destroy_process_group()


def test_gradients_are_averaged(tmp_path):
    _start(_share, tmp_path / "meeting", tmp_path)
    for rank in range(2):
        held = torch.load(tmp_path / f"{rank}.pt")
        assert held["mean"] == 1.5
        assert held["first"].tolist() == [1.5, 3.0, 4.5]
        assert held["second"].tolist() == [0.0, 0.0]


class _Views(lightning.LightningDataModule):
    def __init__(self, views, cloud):
        super().__init__()
        self.views, self.cloud = views, cloud

    def initial_cloud(self, sh_degree):
        return self.cloud

    def train_dataloader(self):
        order = EndlessShuffle(len(self.views), seed=0, start=distributed.get_rank(), every=2)
        return DataLoader(self.views, batch_size=None, sampler=order)


def _fit(rank, views, cloud, out, port):
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "LOCAL_RANK": str(rank), "NODE_RANK": "0"}
    torch.set_num_threads(1)
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}
    trainer = lightning.Trainer(
        max_steps=13,  # of two images
        max_epochs=-1,
        limit_val_batches=0,
        accelerator="cpu",
        devices=2,
        strategy=SplatParallel(process_group_backend="gloo"),
        use_distributed_sampler=False,
        default_root_dir=out,
        logger=False,
        **quiet,
    )
    densification = DefaultDensification(start=1, every=8, grow_grad2d=1e-4)
    module = SplatTrainer(sh_degree=1, sh_every=7, densification=densification)
    trainer.fit(module, _Views(views, cloud))
    parameters = {name: getattr(module.splat, name).detach() for name in PARAMETERS}
    torch.save({"steps": trainer.global_step, "parameters": parameters}, f"{out}/{rank}.pt")


def _free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def test_two_processes_stay_alike(data, tmp_path):
    cloud = data.initial_cloud(1)
    _start(_fit, data.train.views, cloud, tmp_path, _free_port())
    one, two = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert one["steps"] == two["steps"] == 13
    assert len(one["parameters"]["means"]) != len(cloud)
    assert all(torch.equal(value, two["parameters"][name]) for name, value in one["parameters"].items())


def _train(folder, capture, *more):
    command = [sys.executable, str(TOOL), "fit", "--config", "quick_cpu", "--trainer.default_root_dir", str(folder)]
    command += ["--data.init_args.path", str(capture), *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=800, cwd=folder.parent)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_two_processes_make_one_splat(tmp_path):
    """The quick training on one and two processes: as many images, half the steps, about the same picture."""
    capture, psnr, counts = tmp_path / "capture", [], []
    for devices in (1, 2):
        done = _train(tmp_path / f"of{devices}", capture, "--trainer.devices", str(devices))
        assert done.returncode == 0, done.stderr[-2000:]
        assert done.stdout.count("point_cloud.ply\n") == 1  # one process tells it
        log = [row for row in rows(tmp_path / f"of{devices}/csv/metrics.csv") if row.get("val/psnr")]
        psnr.append(float(log[-1]["val/psnr"]))
        (ply,) = (tmp_path / f"of{devices}").rglob("*.ply")
        counts.append(len(read_ply(ply).means))
        stored = torch.load(tmp_path / f"of{devices}/checkpoints/step_{200 // devices:06d}.ckpt", weights_only=True)
        assert stored["splat_training"]["seen"] == 200
        assert stored["splat_training"]["devices"] == devices
        assert len(stored["state_dict"]["model.means"]) == counts[-1]
    assert counts[0] > 1000
    assert counts[1] > 1000
    assert psnr[1] > psnr[0] - 1.0
    checkpoint = tmp_path / "of2/checkpoints/step_000100.ckpt"
    more = _train(
        tmp_path / "of2",
        capture,
        "--trainer.devices",
        "2",
        "--ckpt_path",
        str(checkpoint),
        "--trainer.max_steps",
        "220",
    )
    assert more.returncode == 0, more.stderr[-2000:]
    refused = _train(tmp_path / "new", capture, "--ckpt_path", str(checkpoint))
    assert refused.returncode == 2
    assert "trainer.devices: 2" in refused.stderr
