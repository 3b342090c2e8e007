"""``checkpoint.pt``, from which a run is resumed, and the checks before that.

The file has a checksum (:mod:`gaussian_swaying.runs.seal`), so changed bits are found. Its content is also checked,
field by field, against the initial state of the scene.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.runs.seal import load_sealed

_FIELDS = {"frame": int, "state": dict, "log": list, "config": str, "wall_s": dict}


def log_lines(log: Sequence[Mapping[str, float]], known: list[str]) -> list[str]:
    """A log of frames as a checkpoint stores it: a line of JSON per frame.

    Args:
        log: Diagnostics of all frames so far.
        known: The lines of the first of them; the others are appended, so that each is made once.

    Returns:
        A copy of ``known``.
    """
    known += [json.dumps(entry) for entry in log[len(known) :]]
    return list(known)


def read_checkpoint(path: Path, config: str = "") -> dict[str, Any]:
    """Read a checkpoint; no code in it is executed.

    Args:
        path: ``checkpoint.pt`` of a run.
        config: The configuration with which it must have been written; "" for any.

    Returns:
        Its fields, with the right types; :func:`check_state` checks their content.

    Raises:
        ValueError: If it does not exist or is damaged, or the configuration differs.
    """
    if not path.exists():
        raise ValueError(f"There is nothing to resume in {path.parent}: it has no {path.name}; leave out --resume.")
    try:
        checkpoint = load_sealed(path)
        if not isinstance(checkpoint, dict):
            raise ValueError("it has no fields")
        for name, kind in _FIELDS.items():
            if name not in checkpoint:
                raise ValueError(f"it has no `{name}`")
            if type(checkpoint[name]) is not kind:
                raise ValueError(f"its `{name}` is not of type {kind.__name__}")
        checkpoint["log"] = [json.loads(line) for line in checkpoint["log"]]
    except Exception as error:
        raise unreadable(path, error) from error
    if config and checkpoint["config"] != config:
        try:
            change = first_change(checkpoint["config"], config)
        except Exception as error:  # the text is not a configuration
            raise unreadable(path, ValueError("its `config` is not valid YAML")) from error
        raise ValueError(
            f"The configuration differs from that of the run in {path.parent} ({change}): resume with the same one, or "
            "start again without --resume."
        )
    return checkpoint


def unreadable(path: Path, error: Exception) -> ValueError:
    """The error for a checkpoint that cannot be used."""
    why = (str(error).splitlines() or ["empty"])[0].rstrip(".")
    return ValueError(f"{path} cannot be read as a checkpoint ({why}): start again without --resume.")


def check_state(
    checkpoint: dict[str, Any], start: Any, frame_dt: float, max_nodes: int, edited: bool, entries: Collection[str]
) -> None:
    """Raise ValueError with the reason unless a run can continue from a checkpoint.

    Args:
        checkpoint: From :func:`read_checkpoint`.
        start: The initial state of the scene.
        frame_dt: Time between frames [s].
        max_nodes: Largest number of nodes of a grid.
        edited: Whether edits may have changed the material, and so its internal variables.
        entries: Names of the diagnostics of a frame.
    """
    frame, state, log, wall = (checkpoint[name] for name in ("frame", "state", "log", "wall_s"))
    _require(frame >= 0, "its `frame` is negative")
    wanted = start.state_dict()
    _require(set(state) == set(wanted), f"the fields of its state are not {', '.join(wanted)}")
    nodes = _check_grid(state["grid"], start, max_nodes) if "grid" in wanted else 0
    for name, like in wanted.items():
        if name in ("grid", "substep"):
            continue
        value = state[name]
        if name == "F_total":  # None if it equals F_elastic
            like = start.F_elastic
        if value is None and (name == "F_total" or like is None or (edited and name == "internal")):
            continue
        if like is None and name == "internal" and edited:
            like = start.position[..., 0]
        _require(isinstance(value, Tensor) and isinstance(like, Tensor), f"its `{name}` has another type")
        shape = (*like.shape[:-2], nodes, 3) if name.startswith("node_") else tuple(like.shape)
        actual = (tuple(value.shape), value.dtype)
        _require(actual == (shape, like.dtype), f"its `{name}` is {_kind(*actual)} and not {_kind(shape, like.dtype)}")
        _require(bool(torch.isfinite(value).all()), f"its `{name}` is NaN or infinite")
    _require(_is_number(state["substep"]) and state["substep"] >= 0, "its `substep` is not a duration")
    _require(
        abs(float(state["time"]) - frame * frame_dt) <= 0.01 * frame_dt, f"its `time` is not that of frame {frame}"
    )
    _require(len(log) == frame + 1, f"its `log` does not have {frame + 1} frames")
    for entry in log:
        _require(isinstance(entry, dict) and set(entry) == set(entries), "its `log` lacks diagnostics of a frame")
        _require(
            all(type(value) in (int, float) for value in entry.values()), "its `log` has entries that are not numbers"
        )
    known = all(isinstance(name, str) and _is_number(value) and value >= 0 for name, value in wall.items())
    _require(known, "its `wall_s` has values that are not seconds")


def _check_grid(grid: Any, start: Any, max_nodes: int) -> int:
    """Number of nodes of a stored grid; ValueError if it is not a valid grid."""
    fields = {"dx", "offset", "resolution"}
    _require(
        isinstance(grid, dict) and set(grid) == fields,
        f"the fields of its `grid` are not {', '.join(sorted(fields))}",
    )
    _require(
        type(grid["dx"]) is float and grid["dx"] == start.grid.dx,
        f"the dx of its `grid` is not {start.grid.dx:g} m",
    )
    for name in ("offset", "resolution"):
        three = isinstance(grid[name], (tuple, list)) and len(grid[name]) == 3
        _require(
            three and all(type(value) is int for value in grid[name]), f"its `grid.{name}` is not three whole numbers"
        )
    nodes = math.prod(grid["resolution"]) + (start.grid.node_count - math.prod(start.grid.resolution))
    _require(min(grid["resolution"]) > 0 and nodes <= max_nodes, "its `grid.resolution` is out of range")
    _require(max(abs(value) for value in grid["offset"]) < 2**31, "its `grid.offset` is out of range")
    fixed = start.node_displacement is not None
    same = (tuple(grid["offset"]), tuple(grid["resolution"])) == (start.grid.offset, start.grid.resolution)
    _require(not fixed or same, "its `grid` is not that of the scene")
    return nodes


def _require(good: bool, why: str) -> None:
    if not good:
        raise ValueError(why)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _kind(shape: tuple[int, ...], dtype: torch.dtype) -> str:
    return f"{str(dtype).removeprefix('torch.')} {shape}"


def first_change(old: str, new: str) -> str:
    """The first field in which two configurations differ, by its dotted name."""
    import yaml

    before, after = _flat(yaml.safe_load(old)), _flat(yaml.safe_load(new))
    for name in [*after, *before]:
        if before.get(name) != after.get(name):
            return f"`{name}` was {before.get(name, 'absent')}, now {after.get(name, 'absent')}"
    return "in its order"


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    flat = {k: v for key, item in items for k, v in _flat(item, f"{name}.{key}" if name else str(key)).items()}
    return flat or {name: value}
