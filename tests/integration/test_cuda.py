import json
from pathlib import Path

import pytest
import torch
from shared import beyond, in_both, without_waits

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Box, Cylinder, Everything, HalfSpace, Not, Sphere, Union
from gaussian_swaying.mpm.colliders import VelocityBox, Wall
from gaussian_swaying.mpm.pins import Impulse, PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.recording.trajectory import load_trajectory

pytestmark = pytest.mark.gpu
FLAG = str(Path(__file__).resolve().parents[2] / "configs" / "sim" / "flag.yaml")
BOX = '{"class_path": "Box", "init_args": {"min": [null, null, null], "max": [0.03, null, null]}}'
POLE = f'[{{"class_path": "PinnedRegion", "init_args": {{"region": {BOX}}}}}]'
SMALL = ["--config", FLAG, "--scene.generator.init_args.spacing", "0.05", "--solver.dx", "0.1", "--camera.width", "64"]
SMALL += ["--solver.boundaries", POLE]


def _run(folder, device, frames, *more):
    assert main([*SMALL, "--device", device, "--frames", str(frames), "--output", str(folder), *more]) == 0
    return json.loads((folder / "summary.json").read_text())


def test_same_motion_as_on_the_cpu_and_a_gpu_is_found_without_asking(tmp_path):
    on_gpu = _run(tmp_path / "gpu", "auto", 6)
    assert on_gpu["device"] == torch.cuda.get_device_name()
    assert on_gpu["peak_memory_bytes"]["device"] > 0
    on_cpu = _run(tmp_path / "cpu", "cpu", 6)
    assert on_cpu["substeps"] == on_gpu["substeps"]
    ends = [load_trajectory(tmp_path / name / "trajectory.npz", 5)[0] for name in ("gpu", "cpu")]
    # float32 round-off over 300 substeps of a stable motion
    torch.testing.assert_close(*ends, rtol=0, atol=1e-3)
    assert (tmp_path / "gpu" / "video.mp4").stat().st_size > 1000


def test_resume(tmp_path):
    _run(tmp_path / "run", "cuda", 3)
    resumed = _run(tmp_path / "run", "cuda", 6, "--resume")
    whole = _run(tmp_path / "whole", "cuda", 6)
    assert resumed["frames"] == whole["frames"] == 6
    ends = [load_trajectory(tmp_path / name / "trajectory.npz", 5)[0] for name in ("run", "whole")]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-3)


@in_both
def test_a_step_never_makes_the_host_wait(formulation):
    scene = torch.rand(500, 3, device="cuda")
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.3), metres_per_unit=2.0)
    points = MaterialPoints.create(
        frame.point_to_sim(scene), volume=1e-3, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3
    )
    corner, ball, rod = beyond(z=0.8), Sphere([0, 0, 0], 0.5), Cylinder([1, 1, 1], [1, 2, 0], 1, 1)
    boundaries = [
        PinnedRegion(corner),
        PinnedRegion(corner, velocity=[0.1, 0, 0], angular_velocity=[0, 0, 1], pivot=[0.5, 0.5, 0.5]),
        PinnedRegion(ball, front=[[1, 0, 0]], end=1.0),
        Impulse(ball, [0, 0, 0.1]),
        Wall(HalfSpace([0, 0, -1], [0, 0, 1])),
        Wall(Box([-2, -2, -2], [3, 3, 3])),
        *(VelocityBox(region, [0, 0, 0.1]) for region in (corner, ball, rod, Union([ball, rod]), Not(Everything()))),
    ]
    solver = MPMSolver(0.2, formulation, boundaries=boundaries)
    state = solver.step(solver.init_state(points, frame=frame), 1e-4)
    with without_waits():
        end = solver.step(state, 1e-4, force=torch.zeros(500, 3, device="cuda"))
    assert torch.isfinite(end.position).all()
