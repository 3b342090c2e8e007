"""How far a motion can be trusted: the run again on a coarser grid, and there once more with other substeps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_swaying._files import write_text
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.forces import added, split
from gaussian_swaying.mpm.state import State
from gaussian_swaying.simulation.measure import SimulationDiverged

COARSER = 1.5
"""Cell of the coarser grid in cells of the run."""
ORDER = 2
"""Order of the solver in the size of a cell (docs/accuracy.md); in the substep it is 1."""
SAFETY = 3.0
"""Factor of an error from two grids (Roache 1994, the grid convergence index)."""
MODEL = 0.05
"""Share of the motion by which careful solvers of the same thing differ, so that 9 of 10 frames of Blender's flags and
Newton's posts are within the error (``coverage`` of tools/bench.py)."""
APART = 0.25
"""Two motions are apart when their distance is this share of the motion."""
MOST = 2000  # Gaussians that are compared
STRAIN, MACH = 0.3, 0.1  # above the first a law that is linear at rest is a guess; above the second air is compressible


class Certificate:
    """Follows some Gaussians of a run, then repeats it and estimates the error of their places.

    Args:
        simulation: The simulation that runs.
        frames: Number of its frames.

    Raises:
        ValueError: If the simulation cannot be made again on another grid.
    """

    def __init__(self, simulation: Any, frames: int) -> None:
        if simulation.stepper.copies is not None:
            raise ValueError("`certify` compares one object: leave out `copies`.")
        with torch.inference_mode(False):
            self.coarse = simulation.on_grid(COARSER)
        self.simulation, self.frames = simulation, frames
        scene = simulation.scene
        self.index = scene.simulated[:: -(-len(scene.simulated) // MOST)]
        self.rest = scene.model.means[self.index]
        self.motion: list[Tensor] = []
        self.push: list[Tensor] = []

    def see(self, state: State) -> None:
        """Take the next frame of the run."""
        self.motion.append(_displacement(self.simulation, state, self.index, self.rest))
        self.push.append(_push(self.simulation, state))

    def whole(self, log: Sequence[Mapping[str, Any]], seconds: float, progress: bool = True) -> dict[str, Any]:
        """Repeat the run twice, and tell what follows.

        Args:
            log: Diagnostics of the frames of the run.
            seconds: What the run took [s].

        Returns:
            The entry ``certificate`` of ``summary.json``.
        """
        begin, coarse = time.perf_counter(), self.coarse
        found: dict[str, Any] = {"coarser": COARSER, "dx_m": [self.simulation.solver.dx, coarse.solver.dx]}
        substeps = [sum(entry["substeps"] for entry in log)]
        bar = tqdm(total=2 * self.frames, unit="frame", desc="certificate", disable=not progress)
        try:
            near = nearest_neighbours(coarse.scene.model.means[coarse.scene.simulated], 1, self.rest)[1][:, 0]
            index = coarse.scene.simulated[near.to(coarse.device)]
            motions = [torch.stack(self.motion)]
            for factor in (1.0, _factor(coarse)):
                motion, taken = _motion(coarse, index, self.frames, factor, bar.update)
                motions.append(motion)
                substeps.append(taken)
        except (SimulationDiverged, ValueError) as error:
            return found | {"sentence": f"No error is known, as the run on a coarser grid failed: {error}"}
        finally:
            bar.close()
        unit = self.simulation.scene.frame.metres_per_unit
        found |= error_of([unit * motion for motion in motions], substeps, self.simulation.frame_dt)
        found |= {"balances": self._balances(log), "left": self._left(log), "substeps": substeps}
        spent = time.perf_counter() - begin
        return found | {"seconds": spent, "cost": spent / max(seconds, 1e-9)}

    def plot(self, folder: Path, found: Mapping[str, Any]) -> list[Path]:
        """Write the plot of what :meth:`whole` found; returns its path, none if nothing was found."""
        if "error_m" not in found:
            return []
        write_text(folder / "certificate.svg", plot_of(found, self.simulation.frame_dt))
        return [folder / "certificate.svg"]

    def _balances(self, log: Sequence[Mapping[str, Any]]) -> dict[str, float]:
        """Mass that left the grid, energy that nothing put in, and momentum that no force explains, as shares.

        The forces are means of those at both ends of a frame.
        """
        simulation = self.simulation
        mass, dt = float(simulation.model.points.mass.sum()), simulation.frame_dt
        gravity = torch.tensor(simulation.solver.settings.gravity, dtype=torch.float64)
        energy = [entry["kinetic"] + entry["elastic"] + entry["potential"] for entry in log]
        work, most, gained, done = 0.0, 0.0, 0.0, 0.0
        for entry, now in zip(log, energy, strict=True):
            work += entry["wind_work"]
            done += abs(entry["wind_work"])
            moved = entry["kinetic"] + abs(entry["elastic"]) + abs(entry["potential"] - log[0]["potential"])
            most = max(most, done, moved)
            gained = max(gained, now - energy[0] - work)
        momentum = torch.tensor([[entry[f"momentum_{axis}"] for axis in "xyz"] for entry in log], dtype=torch.float64)
        push = torch.stack(self.push).cpu().double()
        impulse, size = torch.zeros(3, dtype=torch.float64), 0.0
        supports = [name[:-2] for name in log[0] if name.startswith("support_") and name.endswith("_x")]
        for k in range(1, len(log)):
            held = [sum(log[k][f"{name}_{axis}"] for name in supports) for axis in "xyz"]
            force = 0.5 * (push[k - 1] + push[k]) + mass * gravity - torch.tensor(held, dtype=torch.float64)
            force = force - simulation.solver.settings.damping * 0.5 * (momentum[k - 1] + momentum[k])
            impulse += dt * force
            size += dt * float(push[k].norm() + mass * gravity.norm())
        missing = float((momentum[-1] - momentum[0] - impulse).norm())
        return {
            "mass_lost": log[-1]["lost"] / max(simulation.model.points.count, 1),
            "energy_gained": gained / most if most > 0 else 0.0,
            "momentum_unexplained": missing / size if size > 0 else 0.0,
        }

    def _left(self, log: Sequence[Mapping[str, Any]]) -> list[str]:
        """Rules of thumb that the run left."""
        simulation, told = self.simulation, []
        strain = max(max(entry["stretch_max"] - 1, 1 - entry["stretch_min"]) for entry in log)
        if strain > STRAIN:
            told.append(f"strain {strain:.2g}: above {STRAIN:g} the law of the material matters more than the grid")
        air = simulation.stepper.air
        if air is not None and air.resolution.reynolds > air.resolution.resolved:
            resolved = f"eddies above {air.resolution.resolved:.2g} are those of a subgrid model"
            told.append(f"Reynolds number {air.resolution.reynolds:.2g}: {resolved}")
        fastest = float(simulation.stepper.flows().norm(dim=-1).amax())
        if fastest > MACH * 340:
            told.append(f"wind of {fastest:.3g} m/s: above Mach {MACH:g} air is compressible")
        return told


def _displacement(simulation: Any, state: State, index: Tensor, rest: Tensor) -> Tensor:
    return (simulation.painter.deformed(state).means[index] - rest).cpu().double()


def _push(simulation: Any, state: State) -> Tensor:
    force, drag = added([split(force(state), force, state) for force in simulation.stepper.forces])
    total = state.position.new_zeros(3) if force is None else force.sum(-2)
    return total if drag is None else total - (drag[..., None] * state.velocity).sum(-2)


def _factor(simulation: Any) -> float:
    """Substeps of the last run in those of the one before: fewer where that is stable, since they cost less."""
    solver: Any = simulation.solver
    if solver.exact:
        return 0.5
    return 1.5 if solver.substep is not None or solver.cfl > 0.43 else max(0.5, solver.cfl / 0.47)


def _motion(simulation: Any, index: Tensor, frames: int, factor: float, told: Callable[[], Any]) -> tuple[Tensor, int]:
    """Displacements of some Gaussians in every frame [scene units], and the substeps taken."""
    stepper, editor = simulation.stepper, simulation.editor
    state, rest, rows, taken = simulation.start(), simulation.scene.model.means[index], [], 0
    for frame in range(frames):
        if frame:
            steps = None if factor == 1.0 else max(1, round(factor * stepper.substeps(state)))
            state, health = stepper.launch(state, steps).finish()
            state, taken = editor.edit_due(state), taken + health.substeps
        rows.append(_displacement(simulation, state, index, rest))
        told()
    return torch.stack(rows), taken


def _rms(vectors: Tensor) -> Tensor:
    return vectors.square().sum(-1).mean(-1).sqrt()


def error_of(motions: Sequence[Tensor], substeps: Sequence[int], frame_dt: float) -> dict[str, Any]:
    """The error of a motion, from one on a coarser grid and one there with other substeps.

    The error of the grid is Roache's for two grids, ``SAFETY d / (COARSER^ORDER - 1)``; that of the substeps is linear
    in them. No run tells the error of the model; :data:`MODEL` stands for it. The three are added as independent ones.
    From the frame on in which two motions are :data:`APART`, their distance says nothing of the error.

    Args:
        motions: Displacements [m], shape (frames, N, 3): of the run, on cells :data:`COARSER` times as large, and there
            with other substeps.
        substeps: Their number in each of the three.
        frame_dt: Time between frames [s].

    Returns:
        Root mean squares over the points in each frame [m]: ``error_m``, its parts ``grid_m``, ``substep_m`` and
        ``model_m``, and the distance from rest ``motion_m``. ``trusted_s`` is the time up to which the error holds;
        ``chaos_s`` that from which other substeps alone make another motion, or None; ``size_m`` the motion about its
        mean; and a sentence.
    """
    run, coarse, other = motions
    size = float(_rms(run - run.mean(0)).square().mean().sqrt())
    steps = [max(taken, 1) for taken in substeps]
    between = abs(1 / steps[2] - 1 / steps[1])
    apart = _rms(coarse - other)
    grid = SAFETY * _rms(run - coarse) / (COARSER**ORDER - 1)
    substep = SAFETY * apart * (1 / steps[0]) / between if between > 0 else torch.zeros_like(apart)
    motion = _rms(run)
    model = MODEL * motion
    error = (grid.square() + substep.square() + model.square()).sqrt()
    chaos, first = (
        next((k for k in range(len(run)) if max(one[k] for one in distances) > APART * size > 0), len(run))
        for distances in ([apart], [apart, _rms(run - coarse)])
    )
    trusted, within = (max(first, 1) - 1) * frame_dt, error[: max(first, 1)]
    worst, half = float(within.amax()), float(within[: (len(within) + 1) // 2].amax())
    said = f"Up to {trusted:.2g} s places are right within {worst:.2g} m, {worst / (size or 1.0):.0%} of the motion "
    said += f"(root mean square), and up to half of that within {half:.2g} m."
    if first < min(chaos, len(run)):
        said += " After that a coarser grid moves otherwise: lower `solver.dx` to trust more."
    if chaos < len(run):
        said += f" From {chaos * frame_dt:.2g} s on two runs that differ in their substeps alone are apart, which is "
        said += "chaos: frames are statistics then, not predictions."
    rows = {"error_m": error, "grid_m": grid, "substep_m": substep, "model_m": model, "motion_m": motion}
    found: dict[str, Any] = {name: row.tolist() for name, row in rows.items()}
    found |= {"trusted_s": trusted, "chaos_s": None if chaos == len(run) else chaos * frame_dt}
    return found | {"size_m": size, "sentence": said}


def plot_of(certificate: Mapping[str, Any], frame_dt: float) -> str:
    """The motion over time with the band of its error, as SVG; grey from where it is not trusted."""
    motion, error = certificate["motion_m"], certificate["error_m"]
    width, height, left, low = 640, 300, 60, 260
    top = max((a + b for a, b in zip(motion, error, strict=True)), default=0.0)
    top, last = 1.05 * min(top, 3 * max(motion)) or 1.0, max(len(motion) - 1, 1)

    def place(k: int, value: float) -> str:
        return f"{left + (width - left - 20) * k / last:.1f},{low - (low - 30) * min(max(value / top, 0), 1):.1f}"

    upper = [place(k, a + b) for k, (a, b) in enumerate(zip(motion, error, strict=True))]
    lower = [place(k, a - b) for k, (a, b) in enumerate(zip(motion, error, strict=True))]
    line = " ".join(place(k, a) for k, a in enumerate(motion))
    x = float(place(min(round(certificate["trusted_s"] / frame_dt), last), 0.0).split(",")[0])
    ticks = "".join(
        f'<text x="{place(k, 0).split(",")[0]}" y="{low + 18}" text-anchor="middle">{k * frame_dt:.3g} s</text>'
        for k in sorted({round(last * part / 4) for part in range(5)})
    ) + "".join(
        f'<text x="{left - 6}" y="{float(place(0, v).split(",")[1]) + 4:.1f}" text-anchor="end">{v:.2g} m</text>'
        for v in (0.0, top / 2, top)
    )  # fmt: skip
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="12"><rect width="{width}" height="{height}" fill="#fff"/>'
        f'<rect x="{x}" y="30" width="{max(width - 20 - x, 0):.1f}" height="{low - 30}" fill="#eee"/>'
        f'<polygon points="{" ".join(upper + lower[::-1])}" fill="#f5b041" fill-opacity="0.5"/>'
        f'<polyline points="{line}" fill="none" stroke="#1b4f72" stroke-width="1.5"/>'
        f'<path d="M{left},30V{low}H{width - 20}" fill="none" stroke="#333"/>{ticks}'
        f'<text x="{left}" y="18">distance from rest, and the band of its error</text></svg>\n'
    )
