"""The scene that a command is given: a splat or a configuration, and options of ``gaussian-swaying sim``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gaussian_swaying.cli.errors import guessing
from gaussian_swaying.cli.shipped import names, with_shipped
from gaussian_swaying.player.session import settings_of_splat
from gaussian_swaying.simulation.model import resolve_device

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


def words_of(parser: ArgumentParser, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words of a command line that stand alone, and the options of ``gaussian-swaying sim``, in any order."""
    switches = {name for action in parser._actions if action.nargs == 0 for name in action.option_strings}
    words: list[str] = []
    further: list[str] = []
    value_follows = False
    for argument in arguments:
        if value_follows or argument.startswith("-"):
            value_follows = not value_follows and "=" not in argument and argument not in switches
            further.append(argument)
        else:
            words.append(argument)
    return words, further


def settings_of(
    parser: ArgumentParser,
    scene: str | None,
    further: Sequence[str],
    folder: Path,
    tell: Callable[[float, str], None] = lambda share, what: None,
) -> Namespace:
    """The settings of the scene to show.

    Args:
        scene: A splat, a configuration or the name of a shipped one, the folder of a run, or None for the flag or the
            ``--config`` among the further options.
        folder: Gets a file with the parts of a splat, if it has any.
        tell: Called with the share that is done, from 0 to 1, and the name of the next task.
    """
    given = list(further)
    if scene is not None and is_given(given, "--config"):
        raise ValueError(
            "`SCENE` and `--config` both say what to show: leave out one of them, or give a splat with `--scene.ply`."
        )
    config = None if scene is None else _configuration(scene)
    if scene is not None and config is None:
        with guessing(parser):
            device = parser.parse_args([*given, "--scene.ply", scene]).device
        print(f"Looking at {scene} for a first configuration, which takes up to a minute.", flush=True)
        settings = settings_of_splat(parser, scene, resolve_device(device), folder, given, tell)
    else:
        config = config or (None if is_given(given, "--config") else "flag")
        arguments = with_shipped([*(["--config", config] if config else []), *given], "sim")
        with guessing(parser):
            settings = parser.parse_args(arguments)
    return settings


def _configuration(scene: str) -> str | None:
    path = Path(scene)
    if (path / "config.yaml").is_file():
        return str(path / "config.yaml")
    shipped = scene in names("sim") and not path.exists()
    return scene if shipped or path.suffix.lower() in (".yaml", ".yml") else None


def is_given(options: Sequence[str], name: str) -> bool:
    """True if an option is among those of the command line."""
    return any(option.split("=")[0] == name for option in options)
