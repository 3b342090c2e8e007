"""``checkpoint.pt``, from which a run is resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gaussian_swaying._checks import first_line
from gaussian_swaying.runs.saved import load_plain


def log_lines(log: Sequence[Mapping[str, float]], known: list[str]) -> list[str]:
    """Extend ``known``, a log as JSON lines, by the new entries of ``log``.

    Returns:
        A copy of ``known``.
    """
    known += [json.dumps(entry) for entry in log[len(known) :]]
    return list(known)


def read_checkpoint(path: Path, config: str = "") -> dict[str, Any]:
    """Read a checkpoint; no code in it is executed.

    Args:
        config: The configuration with which it must have been written; "" for any.
    """
    if not path.exists():
        raise ValueError(f"There is nothing to resume in {path.parent}: it has no {path.name}; leave out --resume.")
    try:
        checkpoint: dict[str, Any] = load_plain(path)
        checkpoint["log"] = [json.loads(line) for line in checkpoint["log"]]
    except Exception as error:
        why = first_line(error).rstrip(".")
        raise ValueError(f"{path} cannot be read as a checkpoint ({why}): start again without --resume.") from error
    if config and checkpoint["config"] != config:
        change = first_change(checkpoint["config"], config)
        raise ValueError(
            f"The configuration differs from that of the run in {path.parent} ({change}): resume with the same one, or "
            "start again without --resume."
        )
    return checkpoint


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
