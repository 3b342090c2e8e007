"""Batches with patches of many directions in the kernels, against torch."""

import pytest
import torch
from shared import longest

from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.simulation.simulation import Simulation

VALUES = [{}, {"wind.speed": 7.0}, {"material.E": 5e3}, {"aero.C_D": 0.4}]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_batch_in_the_kernels_moves_as_in_torch(own):
    times = [0.0, 1 / 24, 4 / 24]
    found = {}
    for device in ("cpu", "cuda"):
        found[device] = list(states_of(Simulation.from_yaml(own / "base.yaml", device=device), VALUES, times))[-1]
    for slow, fast in zip(found["cpu"], found["cuda"], strict=True):
        moved = float(longest(slow.position.sub(fast.position.cpu())))
        assert moved < 1e-3
