"""Warnings about weak guesses, with the commands for the alternatives."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence

from gaussian_swaying import _program as program
from gaussian_swaying.preview.suggest import Suggestion


def preview_command(options: argparse.Namespace, defaults: argparse.Namespace, **changes: str | list[str]) -> str:
    """The command line of the preview with these options, some of them changed.

    Args:
        options: The given options.
        defaults: Default values, which are left out.
        changes: Options to change, by their names in ``options``.
    """
    words = [*program.words("preview"), str(options.scene)]
    for name, default in vars(defaults).items():
        value = changes.get(name, getattr(options, name, default))
        if name == "scene" or value is None or value == default:
            continue
        words.append("--" + name.replace("_", "-"))
        if value is True:
            continue
        listed = isinstance(value, Sequence) and not isinstance(value, str)
        words += [f"{v:g}" if isinstance(v, float) else str(v) for v in (value if listed else [value])]
    return shlex.join(words)


def doubts(found: Suggestion, options: argparse.Namespace, defaults: argparse.Namespace) -> list[str]:
    """Warnings about weak guesses, each with the command for the guess and the one for the next best.

    Args:
        found: The guesses.
        options: Options of the preview.
        defaults: Their defaults.

    Returns:
        Lines of text; none if all guesses are good.
    """
    lines: list[str] = []
    if found.up.confidence == "low":
        lines.append("warning: the up axis is a weak guess; check the picture, and set it:")
        for name, words in zip(found.up.options, ("as guessed", "the next best"), strict=False):
            lines.append(f"  {preview_command(options, defaults, up=name.split())}   # {words}")
    if found.hold.confidence == "low":
        lines.append(
            f"warning: that it is held at the {found.hold.end} is a weak guess; check the picture, and set it:"
        )
        for name, words in zip(found.hold.options, ("as guessed", "the next best"), strict=False):
            lines.append(f"  {preview_command(options, defaults, hold=name)}   # {words}")
    return lines
