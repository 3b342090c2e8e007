"""The short help of ``gaussian-swaying sim --help``: the options used most; ``--help-all`` shows the rest too."""

from __future__ import annotations

from argparse import SUPPRESS, Action, _ArgumentGroup
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

COMMON = {
    "The run": ("config", "preset", "output", "frames", "resume", "device"),
    "The object": ("scene.ply", "scene.up", "scene.longest_side", "scene.region"),
    "Its material, and where it is held": (
        "material.E", "material.density", "material.thickness", "solver.dx", "solver.boundaries"
    ),
    "The wind": ("wind.flow", "wind.modulations"),
    "The pictures": ("camera", "recorder.renders", "recorder.ply_every"),
}  # fmt: skip
"""The options that ``--help`` shows, by what they are about."""

_MORE = (
    "Every field of the configuration is an option, such as --camera.init_args.width 1920. --help-all lists all "
    "fields, --camera.help OrbitCamera those of a class, and --print_config prints the configuration that results."
)


class CommonHelp(Action):
    """Prints the help on the common options, and ends the program."""

    def __init__(self, option_strings: list[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest=SUPPRESS, default=SUPPRESS, nargs=0, help=options["help"])

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Print and exit."""
        print(common_help(parser), end="")
        parser.exit()


def common_help(parser: ArgumentParser) -> str:
    """Return the help on the options of ``COMMON``, with the texts of the full help.

    Args:
        parser: From :func:`~gaussian_swaying.config.parser.build_parser`.
    """
    known = {action.dest: action for action in parser._actions}
    helps = _ArgumentGroup(parser, "Help")
    helps._group_actions = [
        action for action in parser._actions if action.option_strings[-1] in ("--help", "--help-all")
    ]
    groups = [helps]
    for title, names in COMMON.items():
        groups.append(_ArgumentGroup(parser, title))
        groups[-1]._group_actions = [known[name] for name in names]
    whole: Any = parser  # its groups are exchanged meanwhile
    before = whole._action_groups, whole.usage, whole.epilog
    try:
        whole._action_groups, whole.usage, whole.epilog = groups, "%(prog)s --config FILE [options]", _MORE
        return parser.format_help()
    finally:
        whole._action_groups, whole.usage, whole.epilog = before
