"""The main entry point: a splat in the wind, frame by frame."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import nn

from gaussian_swaying._checks import check_choice, check_frames, check_positive, check_vector
from gaussian_swaying._turns import in_turn
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.config.parser import (
    NOT_COMPARED,
    PYTHON_ONLY,
    arguments_of,
    build_parser,
    check_settings,
    config_text,
    parse_file,
    python_text,
)
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.contact.surface import Contact
from gaussian_swaying.mpm.forces import Force, as_forces
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import CameraPath
from gaussian_swaying.rendering.protocol import Renderer
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.defaults import (
    DeviceLike,
    HoldLike,
    SceneLike,
    WindLike,
    as_camera,
    as_scene,
    as_solver,
    as_wind,
    check_types,
    resolve_device,
)
from gaussian_swaying.simulation.edits import Edit, SceneEditor
from gaussian_swaying.simulation.frame import Frame
from gaussian_swaying.simulation.normalisation import Normalisation
from gaussian_swaying.simulation.painter import Painter
from gaussian_swaying.simulation.parameters import Setup, with_values
from gaussian_swaying.simulation.run import run
from gaussian_swaying.simulation.scene import Material, SimulatedScene
from gaussian_swaying.simulation.stepping import Stepping

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


class Simulation(Stepping):
    """A splat in the wind. The constructor is the schema of the YAML; every component also works on its own.

    Positions and regions are given in scene units and axes; velocities, gravity and light in metres, z up. Threads that
    share a simulation take turns.

    Args:
        scene: The source of the Gaussians, and the choice of those that move. In Python also a file, Gaussians or a
            scene made in code; these are simulated as a whole, with the defaults of a :class:`Scene`.
        material: The material of the object; :class:`Material` with its defaults if None.
        solver: Grid, formulation, gravity and boundaries; if None, a grid of 32 cells along the longest side.
        wind: Air velocity over time; in Python also one that varies in space, or three numbers [m/s]. Still air if
            None.
        aero: Force of the wind on patches; :class:`AeroForce` with its defaults if None.
        contact: Contact of the material with itself; null for none. Obstacles are boundaries of the solver.
        forces: Custom forces besides gravity and wind, each given by its class path.
        shader: Shading; null keeps the splat's colours.
        camera: Camera path; if null, an orbit camera on the side of the photos, if one of ``cameras`` is that of a
            capture, or else one that sees the wind blow to the right.
        cameras: Additional cameras by name; their pictures and videos go to the folders cameras/NAME.
        edits: Changes to parts of the object. Each has a `region` (at rest, in scene units; null for everything that
            moves), a `time` [s] from which it applies, any of `E` [Pa], `nu`, `density` [kg/m³] and `law`, and a
            `color` (red, green, blue in [0, 1]) that keeps the fraction `detail` of the old brightness differences.
        recorder: Outputs of :meth:`run`; :class:`Recorder` with its defaults if None.
        normalisation: Read boundaries, and the regions of material and edits, in PhysGaussian's normalised space; null
            for scene units.
        background: Background colour in [0, 1].
        frame_dt: Time between frames [s].
        dtype: Precision of the solver.
        device: auto uses a CUDA GPU if there is one.
        up: Python only, if ``scene`` is not a :class:`Scene`: direction in the scene that points up.
        hold: Python only, if no solver is given: what is held in place. A region, or a pin with a kind of its own:
            ``PinnedRegion(region, kind="clamp")`` also holds the slope, ``PinnedPoints`` holds given places.
        renderer: Python only: draws the Gaussians; by default gsplat on CUDA and the torch renderer elsewhere.

    Raises:
        ValueError: If a value is out of range, or given twice; the message names the field.

    Example:
        >>> from gaussian_swaying.geometry.regions import Box
        >>> from gaussian_swaying.scenes.procedural import FlagScene
        >>> simulation = Simulation(
        ...     FlagScene(spacing=0.1), hold=Box([None, None, None], [0.11, None, None]), wind=[4, 0, 0], device="cpu"
        ... )
        >>> [round(frame.time, 2) for frame in simulation.frames(3)]
        [0.0, 0.04, 0.08]
    """

    def __init__(
        self,
        scene: SceneLike,
        material: Material | None = None,
        solver: MPMSolver | None = None,
        wind: WindLike | None = None,
        aero: AeroForce | None = None,
        contact: Contact | None = None,
        forces: list[Force] = [],  # noqa: B006  (never changed; the schema of the config shows it)
        shader: Shader | None = None,
        camera: CameraPath | None = None,
        cameras: dict[str, CameraPath] | None = None,
        edits: list[Edit] = [],  # noqa: B006
        recorder: Recorder | None = None,
        normalisation: Normalisation | None = None,
        background: list[float] = [0.0, 0.0, 0.0],  # noqa: B006
        frame_dt: float = 0.04,
        dtype: Literal["float32", "float64"] = "float32",
        device: DeviceLike = "auto",
        up: Sequence[float] | None = None,
        hold: HoldLike | None = None,
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__()
        given = {name: value for name, value in locals().items() if name not in ("self", "__class__", *NOT_COMPARED)}
        check_positive("frame_dt", frame_dt)
        check_types(given | {"recorder": recorder})
        check_choice("dtype", dtype, ("float32", "float64"))
        colour = check_vector("background", background)
        target = resolve_device(device)
        settings, material = as_scene(scene, up), material or Material()
        cloud = settings.cloud()  # read once
        solver = as_solver(solver, hold, settings, cloud)
        if normalisation is not None:
            if hold is not None:
                raise ValueError("`hold` cannot be combined with `normalisation`: give a solver with the pins.")
            placed = normalisation.place(settings, material, solver, camera, cameras, edits, cloud)
            settings, material, solver, camera, cameras, edits = placed
        apart = [
            part.region for part in (*solver.boundaries, *edits) if isinstance(getattr(part, "region", None), Region)
        ]
        model = SimulatedScene(
            settings, material, solver.dx, getattr(torch, dtype), cloud, solver.neighbours_fixed, apart
        )
        if contact is not None and not solver.neighbours_fixed:
            raise ValueError(
                "`contact` needs `solver.formulation: total`: leave it out, as in `updated` material meets on the grid."
            )
        obstacles = [part for part in solver.boundaries if isinstance(part, Obstacle)]
        model.take_contact(contact, obstacles)
        blowing = as_wind(wind, model.frame)
        camera = as_camera(camera, cameras, blowing, model)
        self.painter = Painter(model, shader, camera, cameras, colour, frame_dt, renderer)
        self.material = material
        self.solver, self.aero, self.frame_dt = solver, aero or AeroForce(), float(frame_dt)
        self.wind = blowing
        self.custom_forces = nn.ModuleList(force.in_frame(model.frame) for force in as_forces(forces))
        self.to(target)
        self.editor = SceneEditor(model, edits)
        self.recorder = recorder or Recorder()
        self.frames_wanted = 250  # of a run; those of the file, if there is one
        self._text, self._changed, self._given = "", set(given), given

    def __setattr__(self, name: str, value: Any) -> None:
        """Of the arguments, only these can be assigned later: ``wind``, ``aero``, ``frame_dt`` and ``recorder``."""
        if "_given" in self.__dict__ and name in (*self._given, *PYTHON_ONLY, "device"):
            if name not in ("wind", "aero", "frame_dt"):
                raise AttributeError(
                    f"`{name}` is given when a simulation is made: make another Simulation. Between frames you can "
                    "assign `wind`, `aero` and `frame_dt`, change the material with `edit`, and the pictures in "
                    "`painter`."
                )
            check_types({name: value})
            if name == "frame_dt":
                check_positive(name, value)
                value = float(value)
            else:
                value = (as_wind(value, self.scene.frame) if name == "wind" else value or AeroForce()).to(self.device)
            self._note(**{name: value})
        super().__setattr__(name, value)

    # ---- numbers that may change

    @property
    def setup(self) -> Setup:
        """Return the present scene, material and drivers; see :mod:`gaussian_swaying.simulation.parameters`."""
        forces = tuple(force for force in self.custom_forces if isinstance(force, Force))
        points = self.scene.points
        return Setup(self.scene, self.material, points, self.wind, self.aero, forces, self.solver.settings)

    @in_turn
    def change(self, state: MPMState, values: Mapping[str, Any]) -> MPMState:
        """Change numbers between two frames; they stay changed when the simulation starts again.

        Args:
            state: The state now.
            values: Values by the names of :mod:`gaussian_swaying.simulation.parameters`, such as ``wind.speed`` or
                ``material.E``.

        Returns:
            The state from which the run continues.

        Raises:
            ValueError: If there is no such parameter, a value is out of range, or the simulation has no place for it;
                everything then stays as it was.
        """
        changed = self.adopt(with_values(self.setup, values), state)
        assert changed is not None
        return changed

    @in_turn
    def adopt(self, setup: Setup, state: MPMState | None = None) -> MPMState | None:
        """As :meth:`change`, with a setup; without a state, before the simulation starts."""
        before, editor = self.setup, self.editor
        if setup.points is not before.points and editor.edits:
            raise ValueError("`edits` give the material of parts of the object: change it there, not everywhere.")
        try:
            return self._adopt(setup, state)
        except Exception:
            self._adopt(before, state)
            raise

    def _adopt(self, setup: Setup, state: MPMState | None) -> MPMState | None:
        before = self.setup
        with torch.inference_mode(False):
            if setup.wind is not before.wind:
                self.wind = setup.wind
            if setup.aero is not before.aero:
                self.aero = setup.aero
            if any(a is not b for a, b in zip(setup.forces, before.forces, strict=True)):
                self.custom_forces = nn.ModuleList(setup.forces).to(self.device)
                self._note(forces=list(setup.forces))
            if setup.points is not before.points:
                self.scene.points = setup.points
                self.editor.rebase(setup.points)
                object.__setattr__(self, "material", setup.material)
                self._note(material=setup.material)
            if setup.solver is not before.solver:
                self.solver.settings = setup.solver
                self._note(solver=self.solver)
        if state is None or (setup.points is before.points and setup.solver is before.solver):
            return state
        return self._take(state, torch.zeros_like(setup.points.mass, dtype=torch.bool))

    def _note(self, **given: Any) -> None:
        """Remember what has changed, so that a run with other values is not resumed."""
        self._given.update(given)
        self._changed.update(given)

    @property
    def config(self) -> str:
        """Return the resume key of a run as YAML: the configuration file, and the arguments given in Python."""
        heading = "changed_in_python" if self._text else "made_in_python"
        return self._text + python_text(heading, {name: self._given[name] for name in self._changed})

    @config.setter
    def config(self, text: str) -> None:
        self._text, self._changed = text, set()

    # ---- from a YAML file

    @classmethod
    def parser(cls) -> ArgumentParser:
        """The parser of ``gaussian-swaying sim``, see :func:`~gaussian_swaying.config.parser.build_parser`."""
        return build_parser(cls)

    @classmethod
    def from_yaml(cls, path: str | os.PathLike[str], **changes: Any) -> Simulation:
        """The simulation of a configuration file.

        Args:
            path: The YAML file.
            changes: Arguments of the constructor that replace those of the file.

        Returns:
            The simulation. :meth:`run` saves the configuration with the results, with a note of the changes.

        Raises:
            ValueError: If the file or a value in it is invalid; the message names the field.
            TypeError: If the constructor has no such argument.
        """
        parser = cls.parser()
        return cls.from_settings(parser, parse_file(parser, path), **changes)

    @classmethod
    def from_settings(cls, parser: ArgumentParser, settings: Namespace, **changes: Any) -> Simulation:
        """The simulation of parsed settings.

        Args:
            parser: From :meth:`parser`.
            settings: The settings that it parsed.
            changes: As in :meth:`from_yaml`.
        """
        check_settings(cls, settings)
        text, parts = config_text(parser, settings), parser.instantiate(settings)
        simulation = cls(**{name: parts.get(name) for name in arguments_of(cls)} | changes)
        simulation.config = text
        simulation._changed |= set(changes) - set(NOT_COMPARED)
        simulation.frames_wanted = settings.frames
        return simulation

    # ---- frames

    @in_turn
    def frames(self, count: int) -> Iterator[Frame]:
        """Simulate from rest, frame by frame. Timed edits act between frames, as in :meth:`run`.

        Anything assigned between two frames, such as another ``wind``, applies from the next frame on.

        Args:
            count: Number of frames, the first at rest.

        Returns:
            The frames. Read a frame before the next one: an edit changes the scene for all of them. One loop at a time,
            in whatever thread: starting again ends the loop before.

        Raises:
            SimulationDiverged: If the simulation diverges.
            ValueError: As in :meth:`start`.
        """
        check_frames("count", count)
        return self.frames_from(self.start(), 0, count)

    # ---- the run

    @in_turn
    def run(
        self,
        output: str | os.PathLike[str],
        frames: int | None = None,
        resume: bool = False,
        settings: Mapping[str, Any] | None = None,
        progress: bool = True,
        recorder: Recorder | None = None,
    ) -> dict[str, Any]:
        """Simulate, render and record, as ``gaussian-swaying sim`` does.

        Args:
            output: Folder of the results.
            frames: Number of frames; the first is the state at rest; those of the file, or 250, if None.
            resume: Continue the run found in ``output`` after its last complete frame.
            settings: Additional entries for the summary.
            progress: Show a progress bar.
            recorder: Outputs from now on; the recorder of the constructor if None.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            SimulationDiverged: If the simulation diverges; everything recorded so far is saved first.
            ValueError: If the output cannot be written or resumed, or the camera lies inside the object.
        """
        self.recorder = recorder or self.recorder
        count = self.frames_wanted if frames is None else check_frames("frames", frames)
        return run(self, Path(output), count, resume, dict(settings or {}), progress)
