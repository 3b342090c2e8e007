"""A first configuration: its files, beside others that may have been edited, and what is said of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import Cost, estimate_cost
from gaussian_swaying.suggestion.picture import preview_picture
from gaussian_swaying.suggestion.suggestion import (
    FRAME_DT,
    PICTURE,
    Suggestion,
    as_plain,
    configuration,
    cost_lines,
    run_lines,
    things_lines,
)

SHORT = ("up", "region", "held", "size", "kind", "wind")  # guesses that are told if not all are


def write_starter(found: Suggestion, folder: Path, frames: int) -> list[str]:
    """Write the configuration and its parts; keep earlier ones aside, as they may have been edited."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = (folder / "parts.npz").resolve()
    assert found.path is not None
    keep_aside(folder / "starter.yaml", configuration(found, found.path, parts, frames))
    if found.parts is not None and parts.exists() and not _same(parts, found.parts.parts):
        _rename(parts)
    found.to_yaml(folder / "starter.yaml", frames)
    return [*(["parts.npz"] if found.parts is not None else []), "starter.yaml"]


def keep_aside(path: Path, text: str) -> None:
    """Rename a file with other content, as it may have been edited: ``fit.yaml`` to ``fit.1.yaml``, and so on."""
    if path.exists() and path.read_text(encoding="utf-8") != text:
        _rename(path)


def _same(file: Path, parts: Parts) -> bool:
    try:
        return Parts.load(file).digest() == parts.digest()
    except ValueError:
        return False


def _rename(path: Path) -> None:
    number = 1
    while (other := path.with_suffix(f".{number}{path.suffix}")).exists():
        number += 1
    path.rename(other)


def write_preview(
    found: Suggestion, splat: str, folder: Path, height: int, verbose: bool, frames: int, loaded: float, large: bool
) -> list[str]:
    """Write a suggestion with a picture and its numbers into a folder, and say what was guessed.

    Args:
        splat: The splat as it was named.
        height: Of the picture [pixels].
        loaded: Time to load the program, which a run needs, too [s].
        large: Whether only the constant colours were read.
    """
    import imageio.v3 as iio

    simulation, cloud, things = found.simulation, found.cloud, found.things()
    assert simulation is not None
    cost = estimate_cost(simulation, frames, loaded + found.seconds, cloud=cloud if found.place else None)
    names = write_starter(found, folder, frames)
    iio.imwrite(folder / "preview.png", found.picture(height))
    if things is not None:
        iio.imwrite(folder / "things.png", things)
    told = {name: value for name, value in vars(found).items() if name not in ("cloud", "simulation")}
    _write_numbers(folder, cost, splat=splat, suggestion=told)
    degree = "only constant colours were read" if large else f"SH degree {cloud.sh_degree}"
    lines = [f"{splat}: {len(cloud):,} Gaussians{f', {degree}' if verbose else ''}"]
    if any(cloud.origin):
        lines.append(f"  origin          {counted_from(cloud.origin)}")
    lines += [line for line in things_lines(found) if verbose or " moves " in line]
    for name, text in found.reasons.items():
        if verbose or (name in SHORT and (name != "region" or found.place is None)):
            lines.append(f"  {name:<16}{text if verbose else text.split(';')[0]}")
    if simulation.scene.loose and verbose:
        specks = f"{simulation.scene.loose:,} specks hang on nothing or by a thread"
        lines.append(f"  note: {specks}; they follow their nearest neighbours (scene.loose: carry)")
    lines += [f"  {line}" for line in doubts(found)]
    lines += run_lines(simulation) + cost_lines(cost) if verbose else []
    film = f"{frames * FRAME_DT:.3g} s at {PICTURE[0]} x {PICTURE[1]}"
    run = program.command("sim", "--config", folder / "starter.yaml", "--output", Path("outputs") / folder.name)
    lines += [f"the starter ({film}, {duration(cost.total_seconds)} here):", f"  {run}"]
    names = ["preview.json", "preview.png", *(["things.png"] if things is not None else []), *names]
    return [*lines, _wrote(folder, names, verbose)]


def write_config_preview(simulation: Simulation, folder: Path, height: int, verbose: bool, startup: float) -> list[str]:
    """Draw what a configuration does, and say what it simulates and how long it takes."""
    import imageio.v3 as iio

    cost = estimate_cost(simulation, simulation.frames_wanted, startup)
    picture = preview_picture(simulation, height)
    folder.mkdir(parents=True, exist_ok=True)
    iio.imwrite(folder / "preview.png", picture)
    _write_numbers(folder, cost)
    return [*run_lines(simulation), *cost_lines(cost), _wrote(folder, ["preview.png", "preview.json"], verbose)]


def _wrote(folder: Path, names: Sequence[str], verbose: bool) -> str:
    return f"wrote {', '.join(str(folder / name) for name in names)}" + ("" if verbose else "; --verbose says more")


def _write_numbers(folder: Path, cost: Cost, **more: Any) -> None:
    told = more | {"cost": vars(cost) | {"total_seconds": cost.total_seconds}}
    text = json.dumps(told, indent=1, default=as_plain)
    (folder / "preview.json").write_text(text + "\n", encoding="utf-8")


def doubts(found: Suggestion) -> list[str]:
    """Warnings about guesses that are weak or disappoint, each with the option that replaces it."""
    lines: list[str] = []
    count, box = int(found.moving.simulated.sum()), found.moving.box
    if found.moving.confidence == "low" and box is not None:
        corners = " ".join(f"{value:g}" for corner in box for value in corner)
        what = f"that these {count:,} Gaussians are the object is a weak guess"
        lines.append(f"warning: {what}: check the picture, or give another box than --region {corners}")
    held = f"that it is held at the {found.hold.name} is"
    for name, what, guess in (("up", "the up axis is", found.up), ("hold", held, found.hold)):
        if guess.confidence == "low":
            other = "".join(f"; the next best is --{name} {value}" for value in guess.options[1:])
            lines.append(f"warning: {what} a weak guess: check the picture{other}")
    if found.kind == "rigid":
        lines.append("note: little of it sways; if it hangs, add --kind hanging")
    return lines


def splat_name(path: str | Path) -> str:
    """The name of a splat: that of its file, or of the folder of ``point_cloud.ply`` (training) or ``meta.json`` (SOG).

    Folders ``iteration_30000`` and ``point_cloud``, as 3DGS makes them, are skipped.
    """
    file = Path(path)
    if file.stem not in ("point_cloud", "meta"):
        return file.stem
    folders = [part.name for part in file.resolve().parents]
    passed = ("point_cloud", "iteration_")
    return next((name for name in folders if name and not name.startswith(passed)), file.stem)
