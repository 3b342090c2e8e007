"""A recorded run, played back: the simulation that made it, and its Gaussians in each frame."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._files import sha256
from gaussian_swaying.config.parser import parse_file
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.resume import packed_frames
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.simulation import Simulation


class RecordedRun:
    """The motion in the folder of a run, and the simulation of its configuration and splat.

    Args:
        folder: The output folder of ``gaussian-swaying sim``.

    Attributes:
        simulation: Made again, on the CPU.
        summary: The summary of the run.

    Raises:
        ValueError: If there is no run, its splat is missing or another one, or it was made from Python.

    Example:
        >>> for gaussians in RecordedRun("outputs/flag").frames():  # doctest: +SKIP
        ...     print(gaussians.means.mean(0))
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.summary = self._summary()
        self.simulation, self.name = self._simulation()

    def _summary(self) -> dict[str, Any]:
        path = self.folder / "summary.json"
        if not path.is_file() or not (self.folder / "config.yaml").is_file():
            raise ValueError(f"{self.folder} has no run: give the output folder of `gaussian-swaying sim`.")
        try:
            summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            summary["formulation"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} cannot be read ({error}): run the simulation again.") from error
        return summary

    def _simulation(self) -> tuple[Simulation, str]:
        config, parser = self.folder / "config.yaml", Simulation.parser()
        try:
            settings = parse_file(parser, config)
        except ValueError as error:
            python = "made_in_python" in config.read_text(encoding="utf-8", errors="replace")
            why = "the run was made from Python" if python else str(error).rstrip(".")
            raise ValueError(f"{config} cannot be read ({why}): run the simulation again from a file.") from error
        splat = settings.scene.ply
        if splat is not None:
            if not Path(splat).is_file():
                raise ValueError(
                    f"The splat {splat} of the run is not there (`scene.ply` in {config}): put it back, or export from "
                    "the folder in which the run was started."
                )
            if self.summary.get("splat_sha256") not in (None, sha256(Path(splat))):
                raise ValueError(
                    f"The splat {splat} has changed since the run in {self.folder}: restore it, or run again."
                )
        made = getattr(settings.scene.generator, "class_path", "scene").rsplit(".", 1)[-1].removesuffix("Scene")
        return Simulation.from_settings(parser, settings, device="cpu"), made if splat is None else Path(splat).stem

    @cached_property
    def start(self) -> Any:
        """The state at rest; raises the errors of :meth:`Simulation.start`."""
        return self.simulation.start()

    def nodes(self) -> tuple[Tensor, Tensor]:
        """Flat indices (M,) of the recorded nodes in the grid of :attr:`start`, and their displacements [m] (K, M, 3).

        Raises:
            ValueError: If the run has none, or those of another version of the program.
        """
        path, formulation = self.folder / "nodes.npz", self.summary["formulation"]
        if formulation not in ("total", "modes"):
            raise ValueError(
                f"The run in {self.folder} is of `solver.formulation: {formulation}`, where nodes do not move with the "
                "material: a film needs a run of `total`."
            )
        if not path.is_file():
            raise ValueError(f"The run in {self.folder} has no nodes.npz: run it again with `recorder.nodes: true`.")
        displacement, nodes = load_nodes(path), self.simulation.scene.follow.nodes(self.start)
        assert nodes is not None  # the run is of `total`
        if displacement.shape[1] != len(nodes):
            raise ValueError(
                f"{path} has {displacement.shape[1]:,} nodes, but the scene of {self.folder / 'config.yaml'} has "
                f"{len(nodes):,}: export with the version of this program that made the run, or run it again."
            )
        return nodes, displacement

    @torch.inference_mode()
    def frames(self) -> Iterator[DeformedGaussians]:
        """All Gaussians in each frame, from ``nodes.npz`` or the trajectory.

        Their colours are those of the edits so far, so read them before the next frame.
        Displacements have the precision of the file: float16, 0.05 % of each, up to half of the object's size.

        Raises:
            ValueError: If the run recorded no motion.
        """
        states, scene, editor = self._states(), self.simulation.scene, self.simulation.editor
        step = self.simulation.frame_dt
        for frame, state in enumerate(states):
            for edit in editor.due((frame + 1e-3) * step):
                editor.apply(edit, flowed=frame > 0)
            yield scene.deformed(state)

    def _states(self) -> Iterator[Any]:
        """What the Gaussians follow in each frame."""
        start, trajectory = self.start, self.folder / "trajectory.npz"
        if (self.folder / "nodes.npz").is_file():
            nodes, displacement = self.nodes()
            rest = torch.zeros_like(start.node_displacement)
            for row in displacement.to(rest.dtype):
                yield replace(start, node_displacement=rest.index_copy(0, nodes, row))
        elif self.simulation.scene.track is None and trajectory.is_file():
            for frame in sorted(packed_frames(trajectory)):
                position, F = (part.to(start.position.dtype) for part in load_trajectory(trajectory, frame))
                yield SimpleNamespace(position=position, F_total=F)
        else:
            name = "trajectory" if self.simulation.scene.track is None else "nodes"
            raise ValueError(
                f"The run in {self.folder} has no {name}.npz, which moves the Gaussians: run it again with "
                f"`recorder.{name}: true`."
            )
