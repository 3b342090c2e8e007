"""A converted PhysGaussian configuration as a YAML file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any


def to_yaml(settings: Mapping[str, Any], notes: Iterable[str] = (), source: str | None = None) -> str:
    """Settings as a YAML file for ``--config``, with the notes as comments at the top.

    Args:
        settings: From :func:`convert`.
        notes: From :func:`convert`.
        source: Name of the file that was converted.

    Returns:
        The text.
    """
    import textwrap

    import yaml

    head = [f"PhysGaussian's {source or 'configuration'}, converted. Give the splat with --scene.ply PATH.", *notes]
    width = {"width": 118, "break_long_words": False, "break_on_hyphens": False}
    lines = [
        line
        for text in head
        for line in textwrap.wrap(text, initial_indent="# ", subsequent_indent="#   ", **width)  # type: ignore[arg-type]
    ]
    plain = json.loads(json.dumps(settings))  # copies, since YAML would write repeated parts as references
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return "\n".join(lines) + "\n" + body


__all__ = ["to_yaml"]
