"""Memory and time of the gradient through one long rollout of a flag; ``bench.py gradients`` runs it as a process.

``python tools/bench/cases/gradient_memory.py total 500 22``   formulation, substeps, checkpoint (0: none)
"""

import dataclasses
import json
import sys
import time

import torch

from bench.problems.flags import HEIGHT, WIDTH, flag_points
from bench.problems.settings import Settings
from gaussian_swaying._provenance import peak_memory
from gaussian_swaying.aero.force import aero_force
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion


def _peak_mib() -> float:
    return (peak_memory() or 0) / 2**20


def main() -> None:
    """Simulate a flag of about a thousand particles and compute the gradient with respect to E and the wind."""
    formulation, steps, checkpoint = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    before = _peak_mib()
    settings = Settings(formulation=formulation, dtype=torch.float32)
    points = flag_points(0.03, settings, 6e3, 30.0)
    youngs_modulus = torch.tensor(6e3, requires_grad=True)
    wind = torch.tensor([6.0, 1.5, 0.0], requires_grad=True)
    points = dataclasses.replace(points, youngs_modulus=youngs_modulus.expand(points.count))
    solver = settings.solver(0.06, boundaries=[PinnedRegion(Box([None] * 3, [0.07, None, None]))])
    normal, area = torch.zeros_like(points.position), torch.full_like(points.mass, WIDTH * HEIGHT / points.count)
    normal[:, 1] = 1.0
    begin = time.perf_counter()
    state = solver.rollout(
        solver.init_state(points),
        5e-4,
        steps,
        lambda s: aero_force(wind, s.velocity, normal, area, drag=0.1, friction=0.3, lift=0.005),
        checkpoint,
    )
    state.position.square().sum().backward()
    assert youngs_modulus.grad is not None
    row = {"formulation": formulation, "particles": points.count, "substeps": steps, "checkpoint": checkpoint}
    row |= {"memory_MiB": _peak_mib() - before, "seconds": time.perf_counter() - begin}
    print(json.dumps(row | {"gradient_E": float(youngs_modulus.grad)}))


if __name__ == "__main__":
    main()
