"""From a YAML file and the command line to a run. The constructors of the components are the schema."""

from __future__ import annotations

import sys
from argparse import SUPPRESS, Action
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from gaussian_swaying._checks import check_vector
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.cli import program
from gaussian_swaying.cli.errors import run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.cli.suggestions import guessing
from gaussian_swaying.cli.yaml_limits import check_config_files, limit_yaml
from gaussian_swaying.data.capture_camera import CaptureCamera
from gaussian_swaying.mpm.boundary import RegionInFrame
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.rendering.camera_path import CameraPath, OrbitCamera
from gaussian_swaying.rendering.keyframes import KeyframedCamera
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.continuing import how_to_resume
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.edits import Edit
from gaussian_swaying.simulation.physgaussian import convert, read_config, to_yaml
from gaussian_swaying.simulation.physgaussian_camera import PhysGaussianCamera
from gaussian_swaying.simulation.physgaussian_space import Normalisation
from gaussian_swaying.simulation.pipeline import SimulationPipeline
from gaussian_swaying.simulation.recorder import Recorder
from gaussian_swaying.simulation.scene import Material, Scene, SimulatedScene
from gaussian_swaying.simulation.signals import stop_signals

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

# imported so that a configuration can name them without their modules
CAMERA_PATHS = (CaptureCamera, KeyframedCamera)
# what a configuration cannot hold; what may change between a run and the one that resumes it
COMMAND_LINE_ONLY = ("preset", "physgaussian")
RUN_ONLY = ("config", "output", "device", "frames", "resume")


class PhysGaussianAction(Action):
    """Takes a PhysGaussian configuration as ``--config`` takes a YAML file, and prints the differences in meaning."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Convert the file and merge it into what was parsed so far."""
        from jsonargparse import ActionConfigFile

        try:
            settings, notes = convert(read_config(values))
        except ValueError as error:  # which argparse would not report
            raise TypeError(str(error)) from error
        ActionConfigFile.apply_config(parser, namespace, "config", to_yaml(settings))
        namespace["config"][-1] = values
        for note in notes:
            print(f"note: {note}", file=sys.stderr)


class PresetAction(Action):
    """Takes the file of the same name in a folder beside the configuration given before."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Merge the preset into what was parsed so far."""
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
                + (f"; there is {', '.join(there)}." if there else "; leave out --preset.")
            )
        ActionConfigFile.apply_config(parser, namespace, "config", str(preset))


def build_parser() -> ArgumentParser:
    """The parser of ``gaussian-swaying sim``: one group of options per component, typos are errors."""
    from jsonargparse import ActionYesNo, ArgumentParser

    limit_yaml()
    parser = ArgumentParser(
        prog=program.name("sim"),
        exit_on_error=False,
        description="Let the wind move a 3D Gaussian scene: splat in, video out. Lengths that say where something is "
        "are in scene units and axes; velocities, gravity and light are in metres, z up.",
    )
    parser.add_argument("--config", action="config", help="YAML file; options given after it override it.")
    parser.add_argument(
        "--physgaussian",
        action=PhysGaussianAction,
        default=SUPPRESS,
        help="The same for a JSON file of PhysGaussian, which is converted.",
    )
    parser.add_argument(
        "--preset",
        action=PresetAction,
        default=SUPPRESS,
        help="preview: fewer Gaussians, a coarser grid and a small picture, for a laptop; options given after it "
        "override it.",
    )
    parser.add_argument("--output", type=str | None, help="Folder of the results. Default: outputs/<config name>.")
    parser.add_argument(
        "--device", type=Literal["auto", "cpu", "cuda"], default="auto", help="auto takes a CUDA GPU if there is one."
    )
    parser.add_argument("--frames", type=int, default=250, help="Number of frames, the first at rest.")
    parser.add_argument("--frame_dt", type=float, default=0.04, help="Time between frames [s].")
    parser.add_argument(
        "--dtype", type=Literal["float32", "float64"], default="float32", help="Precision of the solver."
    )
    parser.add_argument("--background", type=list[float], default=[0.0, 0.0, 0.0], help="Background colour in [0, 1].")
    parser.add_argument(
        "--resume",
        action=ActionYesNo(no_prefix=None),  # type: ignore[arg-type]
        default=False,
        help="Continue the run found in the output folder.",
    )
    parser.add_argument(
        "--normalisation",
        type=Normalisation | None,
        default=None,
        help="Take boundaries and regions of the material in PhysGaussian's normalised space; null for scene units.",
    )
    parser.add_class_arguments(Scene, "scene")
    parser.add_class_arguments(Material, "material")
    parser.add_class_arguments(MPMSolver, "solver")
    parser.add_class_arguments(WindField, "wind")
    parser.add_class_arguments(AeroForce, "aero")
    parser.add_subclass_arguments(Shader, "shader", required=False, help="Shading; null keeps the splat's colours.")
    parser.add_subclass_arguments(CameraPath, "camera", required=False, help="Where each frame is seen from.")
    parser.add_argument(
        "--edits",
        type=list[Edit],
        default=[],
        help="Changes of a part of the object: its `region` (at rest, scene units; null for all that moves), the "
        "`time` from which they hold [s], any of `E` [Pa], `nu`, `density` [kg/m³] and `law`, and a `color` (red, "
        "green, blue in [0, 1]) with the part `detail` of the old differences in brightness.",
    )
    parser.add_argument(
        "--cameras",
        type=dict[str, CameraPath] | None,
        default=None,
        help="Further cameras by name; their pictures and videos are in the folders cameras/NAME.",
    )
    parser.add_class_arguments(Recorder, "recorder")
    return parser


def resolve_device(name: str) -> torch.device:
    """``auto``, ``cpu`` or ``cuda`` as a device; ValueError if CUDA is asked for and missing."""
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise ValueError(
            "`--device cuda` needs a CUDA GPU and a CUDA build of torch, and there is none: use --device auto or cpu."
        )
    return torch.device("cuda" if name != "cpu" and available else "cpu")


def build_pipeline(parser: ArgumentParser, settings: Namespace) -> tuple[SimulationPipeline, Recorder]:
    """Build the components from parsed settings.

    Args:
        parser: From :func:`build_parser`.
        settings: What it parsed.

    Returns:
        Pipeline and recorder.

    Raises:
        ValueError: If a value is out of range; the message names the field.
    """
    from jsonargparse import Namespace

    device = resolve_device(settings.device)
    for name in COMMAND_LINE_ONLY:
        if name in settings:
            raise ValueError(f"`{name}` is an option of the command line, not of a YAML: remove it and give --{name}.")
    for name in ("scene", "material", "solver", "wind", "aero", "recorder"):
        if not isinstance(settings[name], Namespace):
            raise ValueError(
                f"Expected `{name}` to hold fields, such as those that --help lists, but got {settings[name]!r}."
            )
    if settings.frames < 1:
        raise ValueError(f"Expected `frames` to be at least 1, but got {settings.frames}.")
    parts = parser.instantiate(settings)
    solver = parts.solver
    if parts.normalisation is not None:
        frame = parts.normalisation.place(parts.scene, parts.material, solver, parts.get("camera"))
        for path in (parts.get("cameras") or {}).values():
            if isinstance(path, PhysGaussianCamera):
                path.frame = frame
        for edit in parts.edits:
            edit.region = None if edit.region is None else RegionInFrame(edit.region, frame)
    scene = SimulatedScene(parts.scene, parts.material, solver.dx, getattr(torch, settings.dtype))
    pipeline = SimulationPipeline(
        scene,
        solver,
        parts.wind,
        parts.aero,
        parts.get("shader"),
        parts.get("camera") or OrbitCamera(),
        background=check_vector("background", settings.background),
        frame_dt=settings.frame_dt,
        device=device,
        cameras=parts.get("cameras"),
        edits=parts.edits,
    )
    return pipeline, parts.recorder


def config_text(parser: ArgumentParser, settings: Namespace) -> str:
    """The settings that decide the result, as YAML."""
    kept = settings.clone()
    for name in RUN_ONLY:
        kept.pop(name, None)
    return str(parser.dump(kept, skip_validation=True))


def output_folder(settings: Namespace) -> Path:
    """The folder asked for, or one named after the config file."""
    if settings.output:
        return Path(settings.output)
    files = [str(file) for file in settings.config or []]
    return Path("outputs") / (Path(files[-1]).stem if files else "run")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, build, run.

    Args:
        arguments: Command line; that of the process if None.

    Returns:
        0 if all went well, 2 on bad input or a simulation that diverged, 130 if stopped with Ctrl-C, 143 by SIGTERM,
        129 by SIGHUP. With the environment variable ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = build_parser()
    started: list[SimulationPipeline] = []

    def advice(error: BaseException) -> str | None:
        """How to go on from the checkpoint that the run has left, if it has left one."""
        if not started or started[0].resumable is None:
            return None
        return how_to_resume(*started[0].resumable, arguments, isinstance(error, SimulationDiverged))

    return run_command(
        lambda: _simulate(parser, arguments, started),
        stopped="Stopped; what was recorded is kept.",
        advice=advice,
        memory="a smaller `scene.region`, a coarser `solver.dx` or a smaller picture",
        expected=(SimulationDiverged,),
        arguments=arguments,
    )


def _simulate(parser: ArgumentParser, arguments: Sequence[str], started: list[SimulationPipeline]) -> None:
    """Parse, build, run, and say what was written; ``started`` takes the run once it may leave something."""
    arguments = with_shipped(arguments, "sim")
    check_config_files(arguments)
    with guessing(parser):
        settings = parser.parse_args(arguments)
    pipeline, recorder = build_pipeline(parser, settings)
    folder = output_folder(settings)
    scene = pipeline.scene
    by = f" by {scene.points.count:,} points" if len(scene.simulated) < len(scene.chosen) else ""
    print(f"{len(scene.chosen):,} of {len(scene.model.means):,} Gaussians simulated{by} on {pipeline.device}")
    if scene.loose:
        print(f"{scene.loose:,} loose ones follow their neighbours")
    if scene.filled:
        print(f"{scene.filled:,} points fill the inside")
    print(scene.frame.describe())
    extra: dict[str, Any] = {"config": [str(file) for file in settings.config or []]}
    text = config_text(parser, settings)
    started.append(pipeline)
    with stop_signals():
        summary = pipeline.run(recorder, folder, settings.frames, text, settings.resume, extra)
    seconds = ", ".join(f"{part} {value:.1f} s" for part, value in summary["wall_s"].items())
    print(f"{summary['frames']} frames, {summary['substeps']:,} substeps: {seconds}")
    if summary["torn_particles"]:
        print(
            f"warning: {summary['torn_particles']} particles are farther than two cells from a neighbour, so the "
            "material fell apart numerically: use `solver.formulation: total`, or a coarser `solver.dx`.",
            file=sys.stderr,
        )
    beside = [folder / name for name in ("diagnostics.csv", "checkpoint.pt", "config.yaml")]
    for file in [*pipeline.files, *(file for file in beside if file.exists())]:
        print(f"wrote {file}")
