"""The runs of a sweep as WebDataset shards, and as one picture."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaussian_swaying._checks import check_whole
from gaussian_swaying._files import atomic
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.sweeps.record import RUNS, read_record, read_result

if TYPE_CHECKING:
    from PIL.Image import Image

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

    A sample has

    - ``json``: ``run``, ``settings``, ``summary``, and ``parameter_names`` of
    - ``parameters.npy``: its values on the axes, float64, shape (A,). A vector takes several places. Axes with text or
      lists of different lengths are left out.
    - ``00000.png`` and so on, if wanted: its pictures.
    - ``positions.npy``, if wanted: positions of its particles [m, z up], float32, shape (T, P, 3).
    - ``nodes.npy``, if wanted: displacement of the nodes that the Gaussians follow [m, z up], float32, shape (T, N, 3).

    The same runs give the same bytes.

    Args:
        output: Folder of the files; ``shards`` in the folder of the sweep if None.

    Raises:
        ValueError: If the folder is not a sweep, none of its runs is complete, or something was not recorded.
    """
    import webdataset

    check_whole("runs_per_shard", runs_per_shard, 1)
    folder = Path(folder)
    runs = {f"{number:05d}": run for number, run in enumerate(read_record(folder)["runs"])}
    ended = {name: read_result(folder, name) for name in runs}
    done = {name: result["figures"] for name, result in ended.items() if result and result["status"] == "complete"}
    if not done:
        raise ValueError(f"No run of the sweep in {folder} is complete: finish it with --resume.")
    flat = {name: {axis: _numbers(value) for axis, value in runs[name].items()} for name in done}
    lengths = {axis: {len(run[axis]) for run in flat.values()} for axis in next(iter(flat.values()))}
    axes = {axis: sizes.pop() for axis, sizes in lengths.items() if len(sizes) == 1 and 0 not in sizes}
    named = [axis if size == 1 else f"{axis}.{place}" for axis, size in axes.items() for place in range(size)]

    def sample(name: str) -> dict[str, Any]:
        place, pictures = folder / RUNS / name, _pictures(folder, name)
        trajectory, motion = place / "trajectory.npz", place / "nodes.npz"
        for wanted, asked, there, setting in (
            ("frames", frames, bool(pictures), "recorder.renders with color"),
            ("positions", positions, trajectory.exists(), "recorder.trajectory: true"),
            ("nodes", nodes, motion.exists(), "recorder.nodes: true and solver.formulation: total"),
        ):
            if asked and not there:
                raise ValueError(f"{place} has no {wanted}: leave out `{wanted}`, or sweep with {setting}.")
        told = {"run": name, "settings": runs[name], "parameter_names": named, "summary": done[name]}
        values = np.array([number for axis in axes for number in flat[name][axis]])
        found: dict[str, Any] = {"__key__": name, "json": told, "parameters.npy": values}
        if frames:
            found |= {picture.name: picture.read_bytes() for picture in pictures}
        if positions:
            states = (load_trajectory(trajectory, frame)[0].numpy() for frame in range(int(done[name]["frames"])))
            found["positions.npy"] = np.stack(list(states))
        if nodes:
            found["nodes.npy"] = load_nodes(motion).numpy()
        return found

    target = folder / SHARDS if output is None else Path(output)
    target.mkdir(parents=True, exist_ok=True)
    made, names = [], list(done)
    for first in range(0, len(names), runs_per_shard):
        made.append(target / f"{first // runs_per_shard:06d}.tar")
        with atomic(made[-1]) as temporary, temporary.open("wb") as file, webdataset.TarWriter(file, mtime=0) as tar:
            for name in names[first : first + runs_per_shard]:
                tar.write(sample(name))
    for path in target.glob("[0-9]" * 6 + ".tar"):  # of a sweep with fewer complete runs or smaller shards
        if path not in made:
            path.unlink()
    return made


def _numbers(value: Any) -> list[float]:
    if isinstance(value, Real):
        return [float(value)]
    parts = [_numbers(item) for item in value] if isinstance(value, list) else []
    return [number for part in parts for number in part] if all(parts) else []


def _pictures(folder: Path, run: str) -> list[Path]:
    return sorted((folder / RUNS / run / "frames").glob("[0-9]*.png"))


PER_SHEET = 200  # runs
WIDTH, BAND, GAP = 240, 34, 4  # pixels of a picture, of the text below it, and between two


def write_contact_sheets(folder: Path) -> None:
    """Write the last frame of every run: ``contact_sheet.png``, ``contact_sheet_2.png`` and so on for 200 runs each."""
    runs = {f"{number:05d}": run for number, run in enumerate(read_record(folder)["runs"])}
    for first in range(0, len(runs), PER_SHEET):
        number = f"_{first // PER_SHEET + 1}" if first else ""
        with atomic(folder / f"contact_sheet{number}.png") as temporary:
            _sheet(folder, dict([*runs.items()][first : first + PER_SHEET])).save(temporary)


def _sheet(folder: Path, runs: Mapping[str, Mapping[str, Any]]) -> Image:
    from PIL import Image, ImageDraw, ImageFont, ImageOps

    results, shown = {name: read_result(folder, name) or {"status": "missing"} for name in runs}, {}
    for name, result in results.items():
        pictures = _pictures(folder, name) if result["status"] == "complete" else []
        if pictures:
            with Image.open(pictures[-1]) as picture:
                shown[name] = ImageOps.contain(picture.convert("RGB"), (WIDTH, 4 * WIDTH))
    height = max((picture.height for picture in shown.values()), default=WIDTH * 9 // 16)
    across = max(1, min(len(runs), round(math.sqrt(len(runs) * height / WIDTH * 1.6))))
    size = across * (WIDTH + GAP) + GAP, -(-len(runs) // across) * (height + BAND + GAP) + GAP
    sheet = Image.new("RGB", size, (24, 24, 24))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for number, (name, run) in enumerate(runs.items()):
        left, top = GAP + number % across * (WIDTH + GAP), GAP + number // across * (height + BAND + GAP)
        if name in shown:
            sheet.paste(shown[name], (left, top))
        else:
            draw.text((left + WIDTH / 2, top + height / 2), results[name]["status"], font=font, anchor="mm")
        values = ", ".join(f"{axis.rpartition('.')[2]} {json.dumps(value)}" for axis, value in run.items())
        draw.text((left + 3, top + height + 2), f"{name}\n{values[:40]}", font=font)
    return sheet
