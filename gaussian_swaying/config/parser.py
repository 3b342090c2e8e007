"""Turns a YAML file and the command line into settings. The constructors of the components are the schema."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import inspect
import json
import os
import re
import sys
import tempfile
from argparse import SUPPRESS, Action, ArgumentError, _ArgumentGroup
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Optional, get_args, get_type_hints

from torch import Tensor, nn

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_frames, check_positive
from gaussian_swaying._yaml_limits import limit_yaml
from gaussian_swaying.captures.capture_camera import CaptureCamera
from gaussian_swaying.config.gone import refuse_gone
from gaussian_swaying.config.material_names import NAMES, with_material_option, with_named_materials
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.wind.field import SpatialWind
from gaussian_swaying.wind.tables import FrozenWind, Shelter
from gaussian_swaying.wind.turbulence import Turbulence

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

# imported so that a configuration can use their class names without the module
CAMERA_PATHS = (CaptureCamera,)
EFFECTS = (FrozenWind, Shelter, Turbulence)
# options that a configuration file cannot contain; settings that may change when a run is resumed
COMMAND_LINE_ONLY = ("preset",)
RUN_ONLY = ("config", "output", "device", "frames", "resume", "certify")
# constructor arguments that a YAML file sets within a component instead; components that may be null
PYTHON_ONLY = ("up", "hold", "renderer", "cloud")
NULLABLE = ("air", "contact", "normalisation")
# components of one's own, by class path, and the arguments that they replace
CUSTOM: dict[str, tuple[type, str]] = {"custom_wind": (SpatialWind, "wind"), "custom_solver": (Solver, "solver")}
# arguments that may change between a run and the one that resumes it
NOT_COMPARED = ("device", "recorder", "renderer", "cloud")


class PresetAction(Action):
    """Reads the preset: the file of the same name in a folder next to the configuration given before."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Merge the preset into the settings parsed so far."""
        from jsonargparse import ActionConfigFile

        given = [file for file in namespace.get("config") or [] if file is not None]
        if not given:
            raise TypeError("Expected --config before --preset, which belongs to a configuration.")
        config = Path(str(given[-1]))
        preset = config.parent / str(values) / config.name
        if not preset.is_file():
            there = sorted(path.parent.name for path in config.parent.glob(f"*/{config.name}"))
            raise TypeError(
                f"There is no preset `{values}` of {config}: {preset} is missing"
                + (f"; available: {', '.join(there)}." if there else "; leave out --preset.")
            )
        ActionConfigFile.apply_config(parser, namespace, "config", str(preset))


def build_parser(schema: type) -> ArgumentParser:
    """The parser of ``gaussian-swaying sim``: one group of options per component, typos are errors."""
    from jsonargparse import ActionYesNo

    limit_yaml(lambda found: with_named_materials(refuse_gone(found)))
    parser = _parser_class()(
        prog=program.name("sim"),
        exit_on_error=False,
        add_help=False,
        description="Move a 3D Gaussian scene in the wind: splat in, video out. Positions and regions are in scene "
        "units and axes; velocities, gravity and light are in metres, z up.",
    )
    parser.add_argument("-h", "--help", action=CommonHelp, help="Show the options that people use, and exit.")
    parser.add_argument("--help-all", action="help", help="Show all options, and exit.")
    parser.add_argument("--config", action="config", help="YAML file; options given after it override it.")
    parser.add_argument(
        "--preset",
        action=PresetAction,
        default=SUPPRESS,
        help="preview: fewer Gaussians, a coarser grid and a small picture, for a laptop; options given after it "
        "override it.",
    )
    parser.add_argument("--output", type=str | None, help="Folder for the results. Default: outputs/<config name>.")
    parser.add_argument("--frames", type=int, default=250, help="Number of frames; the first is at rest.")
    parser.add_argument(
        "--resume",
        action=ActionYesNo(no_prefix=None),  # type: ignore[arg-type]
        default=False,
        help="Continue the run found in the output folder.",
    )
    parser.add_argument(
        "--certify",
        action=ActionYesNo(no_prefix=None),  # type: ignore[arg-type]
        default=False,
        help="Run again on a coarser grid, and there with other substeps, and tell how far the motion can be trusted.",
    )
    for name, own in OPTIONS.items():
        parser.add_argument(f"--{name}", type=type(own.default), default=own.default, help=own.help, **own.more)
    groups = _groups(schema)
    for name, component in groups.items():
        parser.add_class_arguments(component, name)
    parser.add_class_arguments(schema, skip={*groups, *PYTHON_ONLY})
    for action in parser._actions:
        if action.dest == "material":
            action.metavar, action.help = "NAME", f"Numbers of a known material ({NAMES}), or a YAML file with fields."
    for name, (kind, replaced) in CUSTOM.items():
        text = f"A {kind.__name__} of your own by its class path, in place of `{replaced}`; null for none."
        parser.add_argument(f"--{name}", type=Optional[kind], default=None, help=text)  # noqa: UP045
    return parser


@cache
def _parser_class() -> type[ArgumentParser]:
    from jsonargparse import ArgumentParser

    class Parser(ArgumentParser):
        def parse_args(  # type: ignore[override]
            self, args: Sequence[str] | None = None, *more: Any, **options: Any
        ) -> Any:
            words = with_lists(sys.argv[1:] if args is None else args)
            refuse_gone({word[2:].partition("=")[0]: None for word in words if word.startswith("--")})
            return super().parse_args(with_material_option(words), *more, **options)

    return Parser


def with_lists(arguments: Sequence[str]) -> list[str]:
    """A command line with brackets round comma-separated numbers, as shells such as zsh eat brackets.

    Example:
        >>> with_lists(["--wind.flow", "-8,0,0", "--region.min=null,0,1e-1"])
        ['--wind.flow', '[-8,0,0]', '--region.min=[null,0,1e-1]']
    """
    number = r"(?:[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|null)"
    return [re.sub(rf"^(--[\w.]+=)?({number}(?:,{number})+)$", r"\1[\2]", argument) for argument in arguments]


def with_custom(parser: ArgumentParser, settings: Namespace, parts: Mapping[str, Any]) -> dict[str, Any]:
    """Instantiated parts with components of one's own in the places of those that they replace."""
    found = dict(parts)
    for name, (_, replaced) in CUSTOM.items():
        own = found.pop(name, None)
        if own is None:
            continue
        if settings[replaced] != parser.get_defaults()[replaced]:
            raise ValueError(f"`{name}` replaces `{replaced}`: leave out one of them.")
        found[replaced] = own
    return found


def arguments_of(schema: type) -> list[str]:
    """The arguments of a constructor that a configuration can contain."""
    return [name for name in inspect.signature(schema).parameters if name not in PYTHON_ONLY]


def _groups(schema: type) -> dict[str, type]:
    hints = get_type_hints(schema.__init__)  # type: ignore[misc]
    found: dict[str, type] = {}
    for name in arguments_of(schema):
        kinds = get_args(hints[name]) if isinstance(hints[name], UnionType) else (hints[name],)
        kinds = tuple(kind for kind in kinds if kind is not type(None))
        if name not in NULLABLE and len(kinds) == 1 and inspect.isclass(kinds[0]) and not inspect.isabstract(kinds[0]):
            found |= {name: kinds[0]} if kinds[0].__module__ != "builtins" else {}
    return found


def import_forces(files: Sequence[str | os.PathLike[str]]) -> None:
    """Import the classes of ``forces`` in configuration files, so that the numbers that they name are known.

    Files that cannot be read and modules that cannot be imported are left to the parser, which names the error.
    """
    import yaml

    for file in files:
        try:
            content = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
            for entry in content.get("forces") or []:
                importlib.import_module(entry["class_path"].rpartition(".")[0])
        except (OSError, ValueError, TypeError, AttributeError, KeyError, ImportError, yaml.YAMLError):
            continue


def parse_file(parser: ArgumentParser, path: str | os.PathLike[str]) -> Namespace:
    """The settings of a configuration file."""
    arguments = ["--config", os.fspath(path)]
    try:
        return parser.parse_args(arguments)
    except ArgumentError as error:
        raise ValueError(str(error)) from error


def parse_text(parser: ArgumentParser, text: str, arguments: Sequence[str] = ()) -> Namespace:
    """The settings of a configuration that is not in a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "starter.yaml"
        path.write_text(text, encoding="utf-8")
        return parser.parse_args(["--config", str(path), *arguments])


def check_settings(schema: type, settings: Namespace) -> None:
    """Raise ValueError if parsed settings contain something that a configuration cannot."""
    from jsonargparse import Namespace

    for name in COMMAND_LINE_ONLY:
        if name in settings:
            raise ValueError(f"`{name}` is a command-line option, not a YAML field: remove it and use --{name}.")
    for name in _groups(schema):
        if not isinstance(settings[name], Namespace):
            raise ValueError(
                f"Expected `{name}` to contain fields, such as those that --help-all lists, but got {settings[name]!r}."
            )
    check_frames("frames", settings.frames)


@dataclasses.dataclass(frozen=True)
class Option:
    """An option that stands for other fields.

    Args:
        default: Its value if it is not given.
        help: What it does.
        apply: Changes settings, which have its value.
        more: Further arguments of ``add_argument``.
    """

    default: Any
    help: str
    apply: Callable[[Namespace], None]
    more: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def _slow(filmed: Namespace) -> None:
    check_positive("slow", filmed.slow)
    filmed.recorder.fps = filmed.recorder.fps or 1 / filmed.frame_dt
    filmed.frames = round((filmed.frames - 1) * filmed.slow) + 1
    filmed.frame_dt = filmed.frame_dt / filmed.slow


def _loop(filmed: Namespace) -> None:
    check_positive("loop", filmed.loop)
    filmed.recorder.loop = filmed.loop / filmed.slow
    filmed.frames += round(filmed.recorder.loop / filmed.frame_dt)


OPTIONS = {
    "slow": Option(1.0, "Slow motion: each second of the wind takes SLOW seconds.", _slow),
    "loop": Option(
        0.0,
        "A film that closes: its last second, or LOOP seconds, become its beginning. It has as many frames as asked "
        "for; more are simulated.",
        _loop,
        {"nargs": "?", "const": 1.0},
    ),
}
"""Options that stand for other fields, in the order in which they apply; another entry is one more."""


def applied(settings: Namespace) -> Namespace:
    """Settings with the fields for which their options stand."""
    found = settings.clone()
    given = {name: own for name, own in OPTIONS.items() if found.get(name, own.default) != own.default}
    for own in given.values():
        own.apply(found)
    for name, own in given.items():
        found[name] = own.default
    return found


def config_text(parser: ArgumentParser, settings: Namespace) -> str:
    """The settings that determine the result, as YAML."""
    kept = settings.clone()
    for name in (*RUN_ONLY, *OPTIONS, *(name for name in CUSTOM if kept.get(name) is None)):
        kept.pop(name, None)
    return str(parser.dump(kept, skip_validation=True))


def scene_name(settings: Namespace) -> str:
    """What a page or a file of a scene is called: its splat, or what its generator makes."""
    if settings.scene.ply is not None:
        return Path(settings.scene.ply).stem
    made = settings.scene.generator
    named = made and made.init_args.get("kind")
    return named or getattr(made, "class_path", "scene").rsplit(".", 1)[-1].removesuffix("Scene")


def python_text(heading: str, arguments: Mapping[str, Any]) -> str:
    """Arguments that were given in Python, as YAML, so that a run with other ones is not continued."""
    import yaml

    return yaml.safe_dump({heading: describe(dict(sorted(arguments.items())))}) if arguments else ""


def option(name: str, value: Any) -> str:
    """A setting as an option of the command line.

    Example:
        >>> option("wind.flow", [4, 0, 0])
        '--wind.flow=[4, 0, 0]'
    """
    return f"--{name}={value if isinstance(value, str) else json.dumps(value)}"


def describe(value: Any) -> Any:
    """Class and values of an argument, down to numbers and text.

    Args:
        value: A number, text, tensor, list, mapping, dataclass, module or any other object with public attributes.

    Returns:
        Plain data for YAML; a tensor becomes its shape and a checksum. Equal values give equal data, in every process.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Tensor):
        held = value.detach().cpu().contiguous()
        return {"shape": list(held.shape), "sha256": hashlib.sha256(held.numpy().tobytes()).hexdigest()}
    if isinstance(value, Mapping):
        return {str(name): describe(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [describe(part) for part in value]
    if isinstance(value, type) or not (hasattr(value, "__dict__") or dataclasses.is_dataclass(value)):
        return getattr(value, "__qualname__", repr(value))
    return {"class": f"{type(value).__module__}.{type(value).__qualname__}", **_parts(value)}


def _parts(value: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        parts = {name: part for name, part in vars(value).items() if not name.startswith("_") and name != "training"}
    if isinstance(value, nn.Module):
        parts |= dict(value.named_parameters(recurse=False)) | dict(value.named_buffers(recurse=False))
        parts |= dict(value.named_children())
    return {name: describe(part) for name, part in sorted(parts.items())}


COMMON = {
    "The run": ("config", "preset", "output", "frames", "resume", "certify", "device"),
    "The object": ("scene.ply", "scene.up", "scene.longest_side", "scene.region"),
    "Its material, and where it is held": (
        "material", "material.E", "material.density", "material.thickness", "solver.dx", "solver.boundaries"
    ),
    "The wind": ("wind.flow", "wind.modulations"),
    "The pictures": ("camera", "recorder.renders"),
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
        print(common_help(parser), end="")
        parser.exit()


def common_help(parser: ArgumentParser) -> str:
    """Return the help on the options of ``COMMON``, with the texts of the full help."""
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
