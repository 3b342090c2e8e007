"""A sweep as a data set of torch, as WebDataset shards, and as a picture of all runs."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from gaussian_swaying._checks import check_positive
from gaussian_swaying._files import atomic, without_nan
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.sweeps.record import RUNS, SUMMARY, read_record, read_result

if TYPE_CHECKING:
    from PIL.Image import Image


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
            item["frames"] = _read_frames(self.folder, self.runs[index])
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


def _read_frames(folder: Path, run: str) -> Tensor:
    from PIL import Image

    files = _pictures(folder, run)
    if not files:
        _check_recorded(folder / RUNS / run / "frames/00000.png", "frames", "recorder.renders with color")
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


SHARDS = "shards"


def write_shards(
    folder: str | os.PathLike[str],
    runs_per_shard: int = 100,
    output: str | os.PathLike[str] | None = None,
    frames: bool = True,
    positions: bool = False,
    nodes: bool = False,
) -> list[Path]:
    """Write the complete runs of a sweep as tar files ``000000.tar`` and so on for WebDataset, which must be installed.

    A sample has ``json`` (run, settings, summary), ``parameters.npy``, and what is wanted of ``00000.png`` and so on
    (its pictures), ``positions.npy`` and ``nodes.npy``, as in :class:`~gaussian_swaying.sweeps.dataset.SweepDataset`.
    The same runs give the same bytes.

    Args:
        folder: Folder of the sweep.
        runs_per_shard: Runs in a file.
        output: Folder of the files; ``shards`` in the folder of the sweep if None.
        frames: Whether to put in the pictures.
        positions: Whether to put in the trajectories.
        nodes: Whether to put in the displacements of nodes.

    Returns:
        The files.
    """
    import webdataset

    check_positive("runs_per_shard", runs_per_shard)
    data = SweepDataset(folder, frames=False, positions=positions, nodes=nodes)
    target = Path(folder) / SHARDS if output is None else Path(output)
    target.mkdir(parents=True, exist_ok=True)
    made = []
    for first in range(0, len(data), runs_per_shard):
        made.append(target / f"{first // runs_per_shard:06d}.tar")
        with atomic(made[-1]) as temporary, temporary.open("wb") as file, webdataset.TarWriter(file, mtime=0) as tar:
            for index in range(first, min(first + runs_per_shard, len(data))):
                tar.write(_sample(data, index, frames))
    for path in target.glob("[0-9]" * 6 + ".tar"):  # of a sweep with fewer complete runs or smaller shards
        if path not in made:
            path.unlink()
    return made


def _sample(data: SweepDataset, index: int, frames: bool) -> dict[str, Any]:
    item, run = data[index], data.runs[index]
    told = {"run": run, "settings": data.settings[index], "parameter_names": data.parameter_names}
    told["summary"] = without_nan(dict(zip(data.summary_names, item["summary"].tolist(), strict=True)))
    sample = {"__key__": run, "json": told}
    sample |= {f"{name}.npy": item[name].numpy() for name in ("parameters", "positions", "nodes") if name in item}
    pictures = _pictures(data.folder, run) if frames else []
    if frames and not pictures:
        raise ValueError(f"Run {run} has no pictures: leave out `frames`, or sweep with recorder.renders of color.")
    return sample | {picture.name: picture.read_bytes() for picture in pictures}


def _pictures(folder: Path, run: str) -> list[Path]:
    return sorted((folder / RUNS / run / "frames").glob("[0-9]*.png"))


PICTURES = ("last", "middle")
PER_SHEET = 200  # runs
WIDTH, BAND, GAP = 240, 34, 4  # pixels of a picture, of the text below it, and between two
BACKGROUND, EMPTY, TEXT = (24, 24, 24), (48, 48, 48), (235, 235, 235)


def write_contact_sheets(folder: Path, picture: str = "last") -> list[Path]:
    """Write ``contact_sheet.png`` of a sweep, and ``contact_sheet_2.png`` ... if there are more than 200 runs.

    Args:
        folder: Folder of the sweep.
        picture: Frame to show, ``last`` or ``middle``.

    Returns:
        The files.
    """
    runs = read_record(folder)["runs"]
    files = []
    for first in range(0, len(runs), PER_SHEET):
        part = {f"{first + number:05d}": run for number, run in enumerate(runs[first : first + PER_SHEET])}
        files.append(folder / ("contact_sheet.png" if first == 0 else f"contact_sheet_{first // PER_SHEET + 1}.png"))
        sheet = _sheet(folder, part, picture)
        with atomic(files[-1]) as temporary:
            sheet.save(temporary)
    return files


def _sheet(folder: Path, runs: Mapping[str, Mapping[str, Any]], picture: str) -> Image:
    from PIL import Image, ImageDraw, ImageFont

    shown = {name: _frame(folder, name, picture) for name in runs}
    sizes = [image.size for image in shown.values() if image is not None]
    height = max((height for _, height in sizes), default=WIDTH * 9 // 16)
    across = max(1, min(len(runs), round(math.sqrt(len(runs) * height / WIDTH * 1.6))))
    down = math.ceil(len(runs) / across)
    sheet = Image.new("RGB", (across * (WIDTH + GAP) + GAP, down * (height + BAND + GAP) + GAP), BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for number, (name, run) in enumerate(runs.items()):
        left, top = GAP + number % across * (WIDTH + GAP), GAP + number // across * (height + BAND + GAP)
        image = shown[name]
        if image is None:
            result = read_result(folder, name) or {"status": "missing"}
            draw.rectangle((left, top, left + WIDTH - 1, top + height - 1), fill=EMPTY)
            what = "no picture" if result["status"] == "complete" else result["status"]
            draw.text((left + WIDTH / 2, top + height / 2), what, TEXT, font, anchor="mm")
        else:
            sheet.paste(image, (left, top))
        lines = [name, ", ".join(f"{axis.rpartition('.')[2]} {_short(value)}" for axis, value in run.items())]
        for line, text in enumerate(lines):
            draw.text((left + 3, top + height + 2 + 15 * line), _fitted(text, draw, font), TEXT, font)
    return sheet


def _frame(folder: Path, name: str, picture: str) -> Image | None:
    """A frame of a run that has ended, small; None if there is none."""
    from PIL import Image

    result = read_result(folder, name)
    if result is None or result["status"] != "complete":
        return None
    files = _pictures(folder, name)
    if not files:
        return None
    with Image.open(files[-1] if picture == "last" else files[len(files) // 2]) as image:
        height = max(1, round(image.height * WIDTH / image.width))
        return image.convert("RGB").resize((WIDTH, height), Image.Resampling.BOX if image.width > WIDTH else 0)


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "[" + ", ".join(_short(item) for item in value) + "]"
    return value if isinstance(value, str) else json.dumps(value)


def _fitted(text: str, draw: Any, font: Any) -> str:
    while text and draw.textlength(text, font) > WIDTH - 6:
        text = text[:-2].rstrip("…") + "…" if len(text) > 2 else ""
    return text
