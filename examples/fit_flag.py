"""Find the speed of a wind and the stiffness of a flag from the motion of the flag alone.

``python examples/fit_flag.py``                     about a minute on one CPU core; exit code 1 if the error is over 2 %
``python examples/fit_flag.py --json result.json``  also writes the result

A small flag, held at its pole side, is released in a steady wind of known direction. The positions of its particles
are recorded at some frames, with noise like that of a camera. The fit then starts from wrong guesses of both numbers
and finds them by gradient descent on the mean squared distance, through every substep of the simulation.

The flag is so soft and heavy that its weight and the wind stretch it by centimetres. A stiff flag only swings, and its
motion would not show how stiff it is. The search interval of each number keeps the substep stable.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as in tools/sim.py; must be set before torch is imported

import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.wind.force import AeroForce

NAMES = ("wind speed", "Young's modulus")
TRUTH = (6.0, 4.0e3)  # m/s, Pa
GUESS = (3.5, 1.4e3)
SOUGHT = ((1.0, 15.0), (5.0e2, 1.2e4))
TOLERANCE = 0.02
MILLIMETRE = 1e-3


@dataclass(frozen=True)
class Setup:
    """What is known about the recording.

    Attributes:
        spacing: Distance between particles [m].
        frames: Number of recorded frames.
        frame_dt: Time between them [s].
        direction: Unit vector along the wind.
        density: Density of the cloth [kg/m³].
        thickness: Thickness of the cloth [m].
    """

    spacing: float = 0.025
    frames: int = 20
    frame_dt: float = 0.02
    direction: tuple[float, float, float] = (0.8, 0.6, 0.0)
    density: float = 30.0
    thickness: float = 0.01


@dataclass(frozen=True)
class Fit:
    """The result of a fit.

    Attributes:
        values: Wind speed [m/s] and Young's modulus [Pa].
        losses: Mean squared distance [mm²] of every simulation.
        seconds: Wall time.
    """

    values: tuple[float, float]
    losses: list[float]
    seconds: float

    def errors(self, truth: tuple[float, float] = TRUTH) -> tuple[float, ...]:
        """Relative errors of the two."""
        return tuple(abs(value / true - 1) for value, true in zip(self.values, truth, strict=True))


def simulate(setup: Setup, speed: Tensor, youngs_modulus: Tensor) -> Tensor:
    """Positions of the particles at every frame [m], shape (frames, P, 3), differentiable by both numbers."""
    scene = FlagScene(width=0.6, height=0.4, spacing=setup.spacing, ripple=0.01)
    model = GaussianSurfaceModel.from_cloud(scene.generate(), requires_grad=False)
    normals, areas = model.normals(), model.areas("coverage")

    def material(youngs_modulus: Tensor | float) -> MaterialPoints:
        return MaterialPoints.create(
            model.means,
            volume=areas * setup.thickness,
            density=setup.density,
            youngs_modulus=youngs_modulus,
            poisson_ratio=0.3,
        )

    pole = PinnedRegion(Box([None, None, None], [setup.spacing, None, None]))
    solver = MPMSolver(dx=2 * setup.spacing, boundaries=[pole])
    aero = AeroForce(C_D=0.1, C_F=0.3, C_L=0.005)
    wind = speed * torch.tensor(setup.direction)

    def force(state: MPMState) -> Tensor:
        return aero(wind, state.velocity, *deform_patch(state.F_total, normals, areas))

    # use the same substeps for every guess: those of the stiffest cloth in the interval
    steps = solver.substeps(solver.init_state(material(SOUGHT[1][1])), setup.frame_dt)
    state = solver.init_state(material(youngs_modulus))
    frames = []
    for _ in range(setup.frames):
        # keep one state per frame; the backward pass recomputes the substeps between them
        state = solver.rollout(state, setup.frame_dt / steps, steps, force, checkpoint=steps)
        frames.append(state.position)
    return torch.stack(frames)


def record(setup: Setup, truth: tuple[float, float] = TRUTH, noise: float = 1e-4, seed: int = 0) -> Tensor:
    """The recorded motion, with Gaussian noise [m] on every coordinate; shape (frames, P, 3)."""
    with torch.no_grad():
        motion = simulate(setup, torch.tensor(truth[0]), torch.tensor(truth[1]))
    generator = torch.Generator().manual_seed(seed)
    return motion + noise * torch.randn(motion.shape, generator=generator)


def fit(
    setup: Setup,
    observed: Tensor,
    guess: tuple[float, float] = GUESS,
    iterations: int = 15,
    report: Callable[[int, float, tuple[float, float]], None] | None = None,
) -> Fit:
    """Find both numbers by L-BFGS with a line search, in the logarithm of each between the ends of its interval.

    Args:
        setup: What is known about the recording.
        observed: Positions [m], shape (frames, P, 3).
        guess: Starting values.
        iterations: Maximum number of iterations; each takes one simulation, sometimes more.
        report: Called after each simulation with its number, mean squared distance [mm²] and the two values.

    Returns:
        The values of the best simulation.
    """
    low, high = torch.tensor(SOUGHT, dtype=torch.float64).log().unbind(-1)
    share = (torch.tensor(guess, dtype=torch.float64).log() - low) / (high - low)
    place = torch.logit(share).requires_grad_()
    optimiser = torch.optim.LBFGS([place], max_iter=iterations, tolerance_change=1e-4, line_search_fn="strong_wolfe")
    runs: list[tuple[float, tuple[float, float]]] = []
    begin = time.perf_counter()

    def loss() -> Tensor:
        optimiser.zero_grad()
        speed, youngs_modulus = (low + (high - low) * torch.sigmoid(place)).exp().float()
        value = ((simulate(setup, speed, youngs_modulus) - observed) / MILLIMETRE).square().sum(-1).mean()
        value.backward()
        runs.append((float(value.detach()), (float(speed.detach()), float(youngs_modulus.detach()))))
        if report is not None:
            report(len(runs), *runs[-1])
        return value

    optimiser.step(loss)
    return Fit(min(runs)[1], [value for value, _ in runs], time.perf_counter() - begin)


def main(arguments: list[str] | None = None) -> int:
    """Record a motion and fit it; returns 0 if both numbers are found within 2 %."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=Setup.frames, help="recorded frames, 0.02 s apart")
    parser.add_argument("--iterations", type=int, default=15, help="maximum number of L-BFGS iterations")
    parser.add_argument("--noise", type=float, default=1e-4, help="noise of the recorded positions [m]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise")
    parser.add_argument("--json", type=Path, default=None, help="file for the result")
    options = parser.parse_args(arguments)
    setup = Setup(frames=options.frames)
    observed = record(setup, noise=options.noise, seed=options.seed)
    print(f"{observed.shape[1]} particles, {setup.frames} frames over {setup.frames * setup.frame_dt:g} s")
    print(f"{'run':>4} {'distance² [mm²]':>16} {'wind [m/s]':>11} {'E [Pa]':>9}")

    def report(run: int, loss: float, values: tuple[float, float]) -> None:
        print(f"{run:4d} {loss:16.4f} {values[0]:11.4f} {values[1]:9.1f}", flush=True)

    result = fit(setup, observed, iterations=options.iterations, report=report)
    errors = result.errors()
    for name, value, true, error in zip(NAMES, result.values, TRUTH, errors, strict=True):
        print(f"{name}: {value:.6g}, true {true:g}, error {100 * error:.3f} %")
    print(f"{len(result.losses)} simulations in {result.seconds:.1f} s")
    found = max(errors) < TOLERANCE
    if options.json is not None:
        recorded = {"seed": options.seed, "noise": options.noise, "setup": asdict(setup), "truth": TRUTH}
        recorded |= {
            "particles": observed.shape[1],
            "guess": GUESS,
            "relative_errors": errors,
            "within_tolerance": found,
        }
        options.json.write_text(json.dumps(recorded | asdict(result), indent=2) + "\n")
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main())
