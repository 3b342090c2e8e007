"""A sweep as a data set of torch: pictures, motion, parameters and figures of every complete run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.sweeps.record import RUNS, SUMMARY, read_record, read_result


class SweepDataset(Dataset[dict[str, Any]]):
    """The complete runs of a sweep, in order; those that failed or are missing are left out.

    An item is a dictionary of

    - ``run``: name of the run.
    - ``parameters``: its values on the axes, float64, shape (A,); ``parameter_names`` names them. A vector takes
      several places. Axes with text or lists of different lengths are left out; ``settings`` has them.
    - ``summary``: figures of its summary, float64, shape (S,); ``summary_names`` names them. NaN where there is none.
    - ``frames``, if wanted: its pictures, uint8, shape (T, 3, H, W).
    - ``positions``, if wanted: positions of its particles [m, z up], float32, shape (T, P, 3), from ``trajectory.npz``.
    - ``nodes``, if wanted: displacement of the nodes that the Gaussians follow [m, z up], float32, shape (T, N, 3),
      from ``nodes.npz``.

    Runs of the same shapes can be put into batches by a ``DataLoader`` as they are.

    Args:
        folder: Folder of the sweep.
        frames: Whether to read the pictures.
        positions: Whether to read the trajectories.
        nodes: Whether to read the displacements of nodes.

    Raises:
        ValueError: If the folder is not a sweep, or none of its runs is complete.
    """

    def __init__(
        self, folder: str | os.PathLike[str], frames: bool = True, positions: bool = False, nodes: bool = False
    ) -> None:
        self.folder, self.frames, self.positions, self.nodes = Path(folder), frames, positions, nodes
        runs = {f"{number:05d}": run for number, run in enumerate(read_record(self.folder)["runs"])}
        ended = {name: read_result(self.folder, name) for name in runs}
        results = {name: result for name, result in ended.items() if result and result["status"] == "complete"}
        if not results:
            raise ValueError(f"No run of the sweep in {folder} is complete: finish it with --resume.")
        self.runs = list(results)
        self.settings: list[Mapping[str, Any]] = [runs[name] for name in self.runs]
        flat = [{axis: _numbers(value) for axis, value in run.items()} for run in self.settings]
        lengths = {axis: {len(run[axis]) for run in flat} for axis in flat[0]}
        axes = {axis: sizes.pop() for axis, sizes in lengths.items() if len(sizes) == 1 and 0 not in sizes}
        self.parameter_names = [
            axis if size == 1 else f"{axis}.{place}" for axis, size in axes.items() for place in range(size)
        ]
        self._parameters = torch.tensor([[n for axis in axes for n in run[axis]] for run in flat], dtype=torch.float64)
        self.summary_names = list(SUMMARY)
        figures = [[result["figures"].get(name) for name in SUMMARY] for result in results.values()]
        self._summary = torch.tensor(
            [[float("nan") if value is None else float(value) for value in row] for row in figures], dtype=torch.float64
        )

    def __len__(self) -> int:
        return len(self.runs)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """The run at a place."""
        place = self.folder / RUNS / self.runs[index]
        item = {"run": self.runs[index], "parameters": self._parameters[index], "summary": self._summary[index]}
        if self.frames:
            item["frames"] = _read_frames(place)
        if self.positions:
            path, count = place / "trajectory.npz", int(self._summary[index, self.summary_names.index("frames")])
            _check_recorded(path, "positions", "recorder.trajectory: true")
            item["positions"] = torch.stack([load_trajectory(path, frame)[0] for frame in range(count)])
        if self.nodes:
            _check_recorded(place / "nodes.npz", "nodes", "recorder.nodes: true and solver.formulation: total")
            item["nodes"] = load_nodes(place / "nodes.npz")
        return item


def _numbers(value: Any) -> list[float]:
    """The numbers in a value, nested lists flattened; empty if it contains anything else."""
    if isinstance(value, Real):
        return [float(value)]
    parts = [_numbers(item) for item in value] if isinstance(value, list) else []
    return [number for part in parts for number in part] if all(parts) else []


def _read_frames(place: Path) -> Tensor:
    from PIL import Image

    files = sorted((place / "frames").glob("[0-9]*.png"))
    if not files:
        _check_recorded(place / "frames" / "00000.png", "frames", "recorder.images: true")
    pictures = []
    for file in files:
        try:
            with Image.open(file, formats=["PNG"]) as image:
                pictures.append(np.asarray(image.convert("RGB")))
        except OSError as error:
            raise ValueError(
                f"{file} cannot be read ({error}): remove its result, and --resume does the run."
            ) from error
    return torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).contiguous()


def _check_recorded(path: Path, wanted: str, setting: str) -> None:
    if not path.exists():
        raise ValueError(f"{path} does not exist: leave out `{wanted}`, or sweep with {setting}.")
