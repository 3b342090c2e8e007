import pytest
import torch
from catalogue import OBSTACLES
from shared import double, near, seeded

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm import contact_kernels as kernels
from gaussian_swaying.mpm.device_functions import Packed

DT = 1e-3


def _path():
    """Between two keys at DT and 30 DT, then at rest."""
    return KeyedPath([DT, 30 * DT], [[0.0, 0.0, 0.0], [0.2, -0.1, 0.05]], [[0.0, 10.0, 20.0], [50.0, -20.0, 90.0]])


def _ask_kernel(obstacle, place, time, device):
    """Gap, normal, velocity, whether it counts and whether one is within 1 cm, at places in the kernel of ``total``."""
    solids = Packed(torch.Size([1]), {"dtype": place.dtype, "device": place.device}, fixed=True)
    solids.take([obstacle.to(device).device_function()], 1)
    solids.begin(time, torch.full_like(time, DT), 1)
    window = torch.tensor(obstacle.window, dtype=torch.float64, device=device)
    count = len(place)
    gap, valid = (torch.full((count,), -7.0, device=device) for _ in range(2))
    facing, drive = (torch.zeros(count, 3, device=device) for _ in range(2))
    within = torch.zeros((), dtype=torch.int32, device=device)
    block = lanes(torch.device(device), 32)
    launch(kernels.obstacle_places, (-(-count // block),))(
        place, torch.zeros(count, 4, device=device), torch.full_like(gap, 0.02), gap, facing, drive, valid, within,
        count, window, solids.buffer, solids.rows, time, torch.full_like(time, DT), 0.01,
        torch.zeros(1, dtype=torch.int32, device=device), 0,
        SOLIDS=solids.layout, BLOCK=block,
    )  # fmt: skip
    return gap, facing, drive, valid, int(within)


@pytest.mark.parametrize("name", OBSTACLES)
def test_distance_normal_and_velocity(kernel_device, name):
    frame = SimFrame(double([0.02, 0.0, 0.01]), rotation_from_z([0, -1, 0]).T, 1.2)
    place = (0.9 * torch.rand(40, 3, generator=seeded(0)) - 0.45).to(kernel_device)
    for more in [{}] if name == "still" else [{}, {"path": _path()}]:
        obstacle = OBSTACLES[name](gap=0.01, start=DT, end=39 * DT, **more).in_frame(frame)
        for moment in (0.0, 7.3 * DT, 40 * DT):
            time = torch.tensor(moment, dtype=torch.float64, device=kernel_device)
            gap, facing, drive, valid, within = _ask_kernel(obstacle, place, time, kernel_device)
            distance, normal, own = obstacle.touch(place.double(), time, DT)
            near(gap.double(), distance - 0.01, 1e-6)
            near(facing.double(), normal, 2e-4)
            near(drive.double(), own, 2e-5)
            assert (valid == float(obstacle.active(time))).all()
            ahead = distance - DT * (own * normal).sum(-1)  # the places are at rest
            assert within == int(bool(obstacle.active(time)) and float(torch.minimum(distance, ahead).min()) < 0.02)
