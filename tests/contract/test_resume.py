"""A run that stopped goes on to the same end, bit for bit, whatever its state holds."""

import numpy as np
import pytest
import torch
from shared import up_to

from gaussian_swaying import Copy, Edit, Material, PinnedRegion, Recorder, Simulation, WindField
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.mpm.laws.elastic import NeoHookean
from gaussian_swaying.mpm.laws.plastic import Sand, Snow
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes import FlagScene, GivenScene, SolidScene
from gaussian_swaying.simulation.body import Scene
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.field import GaussianGust, SineSway
from gaussian_swaying.wind.tables import Shelter
from gaussian_swaying.wind.turbulence import Turbulence

FLAG = FlagScene(spacing=0.1).generate()
PIN = PinnedRegion(up_to(x=0.11))
STRIPS = torch.bucketize(FLAG.means[:, 0].contiguous(), torch.tensor([0.3, 0.7]))
ROLES = [Part("pole", "held"), Part("cloth"), Part("board", "rigid")]
FLOWS = MPMSolver(0.2, "updated", boundaries=[PIN])
CASES = {
    "total": {},
    "modes": {
        "scene": SolidScene("box", size=2.0, spacing=0.2),
        "material": Material(E=1e6, density=300.0, thickness=0.1),
        "solver": MPMSolver(0.4, "modes", boundaries=[PinnedRegion(up_to(z=0.2))]),
    },
    "plastic": {"solver": FLOWS, "material": Material(E=3e3, density=30.0, law=Sand())},
    "solid": {
        "scene": Scene(generator=SolidScene("ball", 0.6, 0.06, gaussians="shell"), filling=InteriorFilling()),
        "solver": MPMSolver(0.12, boundaries=[PinnedRegion(up_to(z=-0.2))]),
    },
    "edits": {
        "edits": [
            Edit(time=0.0, color=[0.0, 1.0, 0.0]),
            Edit(time=0.08, E=2e4, density=60.0, law=NeoHookean(), color=[1.0, 1.0, 1.0]),
            Edit(time=0.16, E=1e4),
        ]
    },
    "a law that flows later": {"solver": FLOWS, "edits": [Edit(time=0.04, law=Snow())]},
    "copies": {"copies": [Copy(), Copy([0.0, 2.0, 0.0], 90.0)]},
    "gusts": {"wind": WindField([6.0, 1.5, 0.0], modulations=[SineSway(0.5), GaussianGust(0.3)], seed=3)},
    "effects": {"wind": WindField([6.0, 1.5, 0.0], effects=[Turbulence(0.2, 1.0, cells=[16, 8, 8]), Shelter(8)])},
    "air": {"air": ComputedAir([-1.0, -1.0, -0.6], [2.0, 1.0, 1.4], 24, speed=9.0)},
    "parts": {"scene": Scene(generator=GivenScene(FLAG), parts=Parts(STRIPS, ROLES)), "solver": MPMSolver(0.2)},
}  # fmt: skip


def simulation(name):
    given = {"scene": FLAG, "solver": MPMSolver(0.2, boundaries=[PIN]), "wind": [6.0, 1.5, 0.0]} | CASES[name]
    return Simulation(material=given.pop("material", Material(E=3e3, density=30.0)), device="cpu", **given)


@pytest.mark.parametrize("name", CASES)
def test_a_run_in_two_parts_is_the_whole_one(name, tmp_path):
    recorder = Recorder(video=False, trajectory=name != "copies", nodes=name != "copies")
    whole = simulation(name).run(tmp_path / "whole", 6, progress=False, recorder=recorder)
    simulation(name).run(tmp_path / "parts", 3, progress=False, recorder=recorder)
    rest = simulation(name).run(tmp_path / "parts", 6, resume=True, progress=False, recorder=recorder)
    assert rest["per_frame"] == whole["per_frame"]
    ends = [tmp_path / name for name in ("whole", "parts")]
    assert len({(end / "frames/00005.png").read_bytes() for end in ends}) == 1
    for file in ("trajectory.npz", "nodes.npz"):
        kept = [np.load(end / file) for end in ends if (end / file).exists()]
        assert len(kept) == 2 or name in ("copies", "plastic", "a law that flows later")
        assert all(np.array_equal(kept[0][key], kept[1][key]) for key in (kept[0] if kept else ()))
    states = [torch.load(end / "checkpoint.pt", weights_only=True)["state"] for end in ends]
    assert states[0].keys() == states[1].keys()
    for key, value in states[0].items():
        assert torch.equal(value, states[1][key]) if isinstance(value, torch.Tensor) else value == states[1][key]
