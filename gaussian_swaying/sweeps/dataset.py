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
        place = folder / RUNS / name
        told = {"run": name, "settings": runs[name], "parameter_names": named, "summary": done[name]}
        values = np.array([number for axis in axes for number in flat[name][axis]])
        found: dict[str, Any] = {"__key__": name, "json": told, "parameters.npy": values}
        if frames:
            pictures = _pictures(folder, name)
            _check_recorded(bool(pictures), place, "frames", "recorder.renders with color")
            found |= {picture.name: picture.read_bytes() for picture in pictures}
        if positions:
            path = place / "trajectory.npz"
            _check_recorded(path.exists(), place, "positions", "recorder.trajectory: true")
            states = (load_trajectory(path, frame)[0].numpy() for frame in range(int(done[name]["frames"])))
            found["positions.npy"] = np.stack(list(states))
        if nodes:
            path = place / "nodes.npz"
            _check_recorded(path.exists(), place, "nodes", "recorder.nodes: true and solver.formulation: total")
            found["nodes.npy"] = load_nodes(path).numpy()
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


def _check_recorded(there: bool, run: Path, wanted: str, setting: str) -> None:
    if not there:
        raise ValueError(f"{run} has no {wanted}: leave out `{wanted}`, or sweep with {setting}.")


PICTURES = ("last", "middle")
PER_SHEET = 200  # runs
WIDTH, BAND, GAP = 240, 34, 4  # pixels of a picture, of the text below it, and between two
BACKGROUND, EMPTY, TEXT = (24, 24, 24), (48, 48, 48), (235, 235, 235)


def write_contact_sheets(folder: Path, picture: str = "last") -> list[Path]:
    """Write ``contact_sheet.png`` of a sweep, and ``contact_sheet_2.png`` ... if there are more than 200 runs.

    Args:
        picture: Frame to show, ``last`` or ``middle``.
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
