"""A picture of all runs of a sweep: one frame of each, with its settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying._files import atomic
from gaussian_swaying.sweeps.record import RUNS, read_record, read_result

if TYPE_CHECKING:
    from PIL.Image import Image

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
    files = sorted((folder / RUNS / name / "frames").glob("[0-9]*.png"))
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
