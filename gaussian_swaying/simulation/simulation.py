"""The main entry point: a splat in the wind, frame by frame."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.contact.surface import Contact
from gaussian_swaying.mpm.forces import Force, as_forces
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.rendering.cameras.camera_path import CameraPath
from gaussian_swaying.rendering.protocol import Renderer
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.config import (
    NOT_COMPARED,
    PYTHON_ONLY,
    arguments_of,
    build_parser,
    check_settings,
    config_text,
    parse_file,
    python_text,
)
from gaussian_swaying.simulation.defaults import (
    DeviceLike,
    SceneLike,
    WindLike,
    as_scene,
    as_solver,
    as_wind,
    check_count,
    check_types,
    resolve_device,
)
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    Gauge,
    Measurement,
    SimulationDiverged,
    TearingGauge,
    check_spacing,
    diagnose,
    measure,
)
from gaussian_swaying.simulation.edits import Edit, SceneEditor
from gaussian_swaying.simulation.frame import Frame
from gaussian_swaying.simulation.launch import Launched, Outlook, needs_of
from gaussian_swaying.simulation.painter import Painter
from gaussian_swaying.simulation.physgaussian.space import Normalisation
from gaussian_swaying.simulation.progress import RunProgress
from gaussian_swaying.simulation.recording.recorder import Recorder
from gaussian_swaying.simulation.run import run
from gaussian_swaying.simulation.scene import Material, SimulatedScene

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

CFL_SAMPLES = 8  # checks per frame, as material may stiffen and soften again within it
MAX_WIND = 1e6  # m/s; anything above is a mistake and would overflow positions
MAX_GROWTH = 1000  # a frame that takes this many times the substeps of the first ends the run
MAX_SUBSTEPS = 1_000_000  # per frame: hours on a CPU, and minutes on the fastest GPU


class Simulation(nn.Module):
    """A splat in the wind. The constructor is the schema of the YAML; every component also works on its own.

    Positions and regions are given in scene units and axes; velocities, gravity and light in metres, z up.

    Args:
        scene: Where the Gaussians come from and which of them move. In Python also a file, Gaussians or a scene made in
            code; these are simulated as a whole, with the defaults of a :class:`Scene`.
        material: What the object is made of; :class:`Material` with its defaults if None.
        solver: Grid, formulation, gravity and boundaries; if None, a grid of 32 cells along the longest side.
        wind: Air velocity over time; in Python also one that varies in space, or three numbers [m/s]. Still air if
            None.
        aero: Force of the wind on patches; :class:`AeroForce` with its defaults if None.
        contact: How the material touches itself; null if it does not. Obstacles are boundaries of the solver.
        forces: Custom forces besides gravity and wind, each given by its class path.
        shader: Shading; null keeps the splat's colours.
        camera: Camera path; an orbit camera if null.
        cameras: Additional cameras by name; their pictures and videos go to the folders cameras/NAME.
        edits: Changes to parts of the object. Each has a `region` (at rest, in scene units; null for everything that
            moves), a `time` [s] from which it applies, any of `E` [Pa], `nu`, `density` [kg/m³] and `law`, and a
            `color` (red, green, blue in [0, 1]) that keeps the fraction `detail` of the old brightness differences.
        recorder: What :meth:`run` writes; :class:`Recorder` with its defaults if None.
        normalisation: Read boundaries, and the regions of material and edits, in PhysGaussian's normalised space; null
            for scene units.
        background: Background colour in [0, 1].
        frame_dt: Time between frames [s].
        dtype: Precision of the solver.
        device: auto uses a CUDA GPU if there is one.
        up: Python only, if ``scene`` is not a :class:`Scene`: direction in the scene that points up.
        hold: Python only, if no solver is given: region whose points are held in place.
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
        hold: Region | None = None,
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
        self.painter = Painter(model, shader, camera, cameras, colour, frame_dt, renderer)
        self.material = material
        self.solver, self.aero, self.frame_dt = solver, aero or AeroForce(), float(frame_dt)
        self.wind = as_wind(wind, model.frame)
        self.custom_forces = nn.ModuleList(force.in_frame(model.frame) for force in as_forces(forces))
        self.to(target)
        self.editor = SceneEditor(model, edits)
        self.recorder = recorder or Recorder()
        self.frames_wanted = 250  # of a run; those of the file, if there is one
        self.progress: RunProgress | None = None  # of the current run
        self.files: list[Path] = []  # what the last run wrote
        self.resumable: tuple[Path, int] | None = None  # the checkpoint of the last run, and its frame
        self.most_substeps = MAX_SUBSTEPS
        self._wind_force: list[WindForce] = []  # in a list, so that it is not part of the module's state
        self._wind_parts: tuple[object, ...] = ()
        self._idle: tuple[tuple[object, ...], bool] | None = None
        self._tearing: TearingGauge | None = None
        self._gauge = Gauge()
        self.outlook: Outlook | None = None  # on the next frame
        self._started = 0  # how often; a loop over frames ends when another one begins
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
            self._given[name] = value
            self._changed.add(name)
        super().__setattr__(name, value)

    @property
    def config(self) -> str:
        """What a run is compared with before it is resumed, as YAML: the file, and the arguments given in Python."""
        heading = "changed_in_python" if self._text else "made_in_python"
        return self._text + python_text(heading, {name: self._given[name] for name in self._changed})

    @config.setter
    def config(self, text: str) -> None:
        self._text, self._changed = text, set()

    # ---- from a YAML file

    @classmethod
    def parser(cls) -> ArgumentParser:
        """The parser of ``gaussian-swaying sim``, see :func:`~gaussian_swaying.simulation.config.build_parser`."""
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

    # ---- parts

    @property
    def scene(self) -> SimulatedScene:
        """Gaussians, material points and patches."""
        return self.painter.scene

    @property
    def device(self) -> torch.device:
        """Device of the components."""
        return self.painter.device

    @property
    def wind_force(self) -> WindForce:
        """The wind on the patches of the scene."""
        parts = (self.aero, self.wind, self.scene.patches)
        if not self._wind_force or any(a is not b for a, b in zip(parts, self._wind_parts, strict=True)):
            with torch.inference_mode(False), torch.no_grad():  # it outlives the call
                self._wind_force, self._wind_parts = [WindForce(*parts)], parts
        return self._wind_force[0]

    @property
    def idle(self) -> bool:
        """Whether the wind has no effect; computed again only if a coefficient changed, as it makes the host wait."""
        aero = self.aero
        key = (aero, aero.air_density, *(0 if c.is_inference() else c._version for c in (aero.C_D, aero.C_F, aero.C_L)))
        if self._idle is None or self._idle[0] != key:
            self._idle = (key, aero.idle)
        return self._idle[1]

    @property
    def forces(self) -> list[Force]:
        """The forces on the particles besides gravity: the wind, unless it has no effect, and the custom forces."""
        custom = [force for force in self.custom_forces if isinstance(force, Force)]
        return custom if self.idle else [self.wind_force, *custom]

    # ---- frames

    def frames(self, count: int) -> Iterator[Frame]:
        """Simulate from rest, frame by frame. Timed edits act between frames, as in :meth:`run`.

        Anything assigned between two frames, such as another ``wind``, applies from the next frame on.

        Args:
            count: Number of frames, the first at rest.

        Returns:
            The frames. Read a frame before the next one: an edit changes the scene for all of them. One loop at a time:
            starting again ends the loop before.

        Raises:
            SimulationDiverged: If the simulation diverges.
            ValueError: As in :meth:`start`.
        """
        check_count("count", count)
        return self.frames_from(self.start(), 0, count)

    def frames_from(
        self, state: MPMState, first: int, count: int, drawn: torch.cuda.Stream | None = None
    ) -> Iterator[Frame]:
        """The frames from number ``first`` up to ``count``.

        Args:
            state: The state at rest from :meth:`start` if ``first`` is 0, otherwise the state of the frame before.
            first: Number of the first frame.
            count: Number of frames of the whole run.
            drawn: A stream on which the frames are drawn and recorded. The next frame is then simulated at the same
                time, so that the GPU does not wait for the host, and what is assigned between two frames applies from
                the next but one on.
        """
        started = self._started
        launched: Launched | None = None
        for index in range(first, count):
            if self._started != started:
                raise RuntimeError(
                    "This simulation was started again, so the earlier loop over its frames cannot go on: finish one "
                    "loop before the next, or make a Simulation for each."
                )
            if index == 0:
                health = diagnose(self.solver, state, 0, 0.0)
            else:
                if launched is None:
                    self._begin(index)
                state, health = self.advance(state) if launched is None else launched.finish()
                if drawn is not None:  # the frame before may still be drawn from memory that is now free
                    torch.cuda.current_stream(self.device).wait_stream(drawn)
                state = self.edit_due(state)
            if drawn is not None and index + 1 < count:
                drawn.wait_stream(torch.cuda.current_stream(self.device))
                self._begin(index + 1)
                launched = self.launch(state)
            yield Frame(self, index, state, health, self.editor.version)

    def _begin(self, index: int) -> None:
        if self.progress is not None:
            self.progress.begin(index)

    def start(self) -> MPMState:
        """The state at rest at time zero, with the edits of that time applied.

        Raises:
            ValueError: If a pin holds nothing, the grid is too large or a fixed substep is too long, now or after one
                of the edits.
        """
        editor, frame = self.editor, self.scene.frame
        self._started += 1
        editor.reset()
        for later in (moment for moment in editor.times if moment > 0):  # refuse impossible edits now
            self._edit(editor.due(0.0))
            self._edit(editor.due(later), flowed=True)
            rehearsed = self.solver.init_state(self.scene.points, frame=frame, surface=self.scene.surface_places)
            self.solver.fused()
            self.solver.substeps(rehearsed, self.frame_dt)
        editor.reset()
        self._edit(editor.due(0.0))
        state = self.solver.init_state(self.scene.points, frame=frame, surface=self.scene.surface_places)
        self._idle = None  # coefficients may have changed
        check_spacing(self.solver)
        self.solver.fused()  # errors of its kernels are raised here
        at_rest = self.solver.substeps(state, self.frame_dt)
        if at_rest > MAX_SUBSTEPS:
            remedy = "soften it (`material.E`, `material.nu`), raise its density or `solver.dx`, or shorten `frame_dt`"
            if self.solver.substep is not None:
                remedy = "raise `solver.substep`, set it to null for the longest that is stable, or shorten `frame_dt`"
            raise ValueError(
                f"A frame of {self.frame_dt:g} s would take {at_rest:,} substeps with this material and grid, more "
                f"than the limit of {MAX_SUBSTEPS:,}: {remedy}."
            )
        self.most_substeps = min(MAX_GROWTH * at_rest, MAX_SUBSTEPS)
        self._tearing = None if self.solver.neighbours_fixed else TearingGauge(self.solver)
        return state

    def edit(self, state: MPMState, *edits: Edit) -> MPMState:
        """Change material or colour now, between two frames; the time of the edits is ignored.

        The solver is set up again for the new material, including its kernels and CUDA graphs. Positions, velocities
        and deformations stay, so momentum changes with the mass and elastic energy with the stiffness.

        Args:
            state: The current state.
            edits: What to change, in this order.

        Returns:
            The state from which the run continues.

        Raises:
            ValueError: If a region contains nothing, or a plastic law is used in the ``total`` formulation.
        """
        before = self.editor.snapshot()
        try:
            return self._take(state, self._edit(edits, flowed=True))
        except Exception:  # nothing stays half changed
            self.editor.restore(before)
            self.solver.init_state(self.scene.points, frame=self.scene.frame, surface=self.scene.surface_places)
            raise

    def _edit(self, edits: Sequence[Edit], flowed: bool = False) -> Tensor | None:
        """Change the scene; returns which particles (P,) got another law, None if the material is the same."""
        changed = [self.editor.apply(edit, flowed) for edit in edits]
        changed = [part for part, edit in zip(changed, edits, strict=True) if edit.of_material]
        return torch.stack(changed).any(0) if changed else None

    def _take(self, state: MPMState, changed: Tensor | None) -> MPMState:
        """Bind the solver to the material of the scene; ``changed`` as from :meth:`_edit`."""
        if changed is None:
            return state
        scene = self.scene
        start = self.solver.init_state(scene.points, frame=scene.frame, surface=scene.surface_places).internal
        if start is not None and state.internal is not None:
            start = torch.where(changed, start, state.internal)
        state = state.replace(internal=start)
        self.solver.fused()
        self.most_substeps = max(
            self.most_substeps, min(MAX_GROWTH * self.solver.substeps(state, self.frame_dt), MAX_SUBSTEPS)
        )
        if self._tearing is not None:
            elastic = self.solver.laws.elastic_particles()
            if elastic is not None:  # particles that flowed apart before are not torn
                self._tearing.elastic = elastic if self._tearing.elastic is None else elastic & self._tearing.elastic
        return state

    def edit_due(self, state: MPMState, resumed: bool = False) -> MPMState:
        """Apply the edits up to the time of a state; a resumed state contains them already."""
        if not self.editor.edits:  # the host need not wait for the time
            return state
        edits = self.editor.due(float(state.time) + 1e-3 * self.frame_dt)
        edited = self._take(state, self._edit(edits, flowed=True))
        return state if resumed else edited

    def advance(self, state: MPMState) -> tuple[MPMState, FrameDiagnostics]:
        """Advance by one frame.

        If the material stiffens so much that the substep was too long, the frame is thrown away and repeated with a
        shorter one. If a particle outruns the grid of the ``updated`` formulation, the frame is repeated on a larger
        grid.

        Args:
            state: The state at the start of the frame.

        Returns:
            The state at its end, and its diagnostics.

        Raises:
            SimulationDiverged: If the simulation diverges in the frame.
        """
        return self.launch(state).finish()

    def launch(self, state: MPMState) -> Launched:
        """Pass a frame to the device; ``launch(state).finish()`` is :meth:`advance`, and the host can work between.

        Args:
            state: The state at the start of the frame.

        Returns:
            The frame. An error of it is raised by its ``finish``.
        """
        if not self.idle:
            self.wind_force.refresh(state)
        return Launched(self, state)

    def measured(
        self,
        end: MPMState,
        steps: int,
        courant: Tensor,
        work: Tensor,
        state: MPMState,
        parts: tuple[object, ...] | None,
    ) -> Measurement:
        """Start the measurements of a frame from ``state`` to ``end``, and of what the next one needs.

        Args:
            end: The state at its end.
            steps: Its substeps.
            courant: Its largest Courant number.
            work: Work of the wind in it [J].
            state: The state at its start.
            parts: From :func:`~gaussian_swaying.simulation.launch.parts_of`.
        """
        if self._tearing is not None or not self.foresees:
            return measure(self.solver, end, steps, courant, work, self._tearing, state)
        idle = self.idle

        def needs(at: MPMState) -> Tensor:
            return needs_of(self, at, None if idle else self._winds(self.wind_force.foreseen(at), at))

        same = None if parts is None else (idle, self.frame_dt, parts)
        return self._gauge(self.solver, end, steps, courant, work, state, needs, same)

    def give_up(self, state: MPMState, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise SimulationDiverged, naming the particle with the largest deformation."""
        particle = int(state.F_elastic.square().sum((-1, -2)).reshape(-1).argmax())
        if remedy is None:
            field = "solver.cfl" if self.solver.substep is None else "solver.substep"
            remedy = f"lower `{field}`, or weaken the wind or the boundary that drives it"
        raise SimulationDiverged(float(state.time), particle, cause, remedy)

    @property
    def foresees(self) -> bool:
        """Whether the needs of the next frame are measured at the end of a frame, so that the host waits once."""
        simple = self.solver.substep is None and self.solver.stiffness_damping == 0
        return simple and self.solver.has_kernels and self.wind_force.recordable

    def substeps(self, state: MPMState, parts: tuple[object, ...] | None = None) -> int:
        """How many substeps the next frame takes, for waves in the material and explicit drag on light patches.

        Args:
            state: The state at its start.
            parts: From :func:`~gaussian_swaying.simulation.launch.parts_of`; with it, what is known is not measured.
        """
        if self.outlook is not None and self.outlook.holds(state, parts):
            cells, rate, blowing = self.outlook.needs
        else:
            winds = None if self.idle else self._winds(self.wind_force, state)
            cells, rate, blowing = needs_of(self, state, winds).tolist()
        steps = self.solver.substeps(state, self.frame_dt, cells)
        if not (math.isfinite(rate) and blowing < MAX_WIND):
            cause = f"the wind of {blowing:.3g} m/s, or its drag, is NaN or infinite or beyond {MAX_WIND:g} m/s"
            self.give_up(state, cause, "check the flow and the modulations of the wind")
        return steps if self.aero.drag_step == "semi_implicit" else max(steps, int(rate * self.frame_dt) + 1)

    def _winds(self, force: WindForce, state: MPMState) -> Tensor:
        """Velocities of the air in the frame that starts with a state [m/s], shape (5, ...)."""
        return force.samples(state, self.frame_dt / 4, 5)

    def _roll(self, state: MPMState, steps: int) -> tuple[MPMState, Tensor]:
        """The state some substeps later, and the largest Courant number on the way."""
        progress = self.progress
        watch = None if progress is None else lambda done: progress.substep(done, steps)
        return self.solver.watched_rollout(state, self.frame_dt / steps, steps, self.forces, CFL_SAMPLES, watch)

    # ---- what is measured

    def wind_pressure(self, state: MPMState) -> Tensor:
        """Force of the wind per area of the Gaussians as they are now [Pa], shape (N,); 0 for those without wind."""
        scene = self.scene
        if self.idle:
            return scene.on_gaussians(torch.zeros_like(scene.in_wind, dtype=state.position.dtype))
        move, F = scene.follow.motion(state)
        normal, area = deform_patch(F, scene.rest_facing.to(F), F.new_ones(len(F)))
        place = scene.frame.point_to_sim(scene.model.means[scene.moving].double()).to(move) + move
        wind = self.wind_force.air(state.time, place)
        force = self.aero(wind, scene.follow.velocity(state), normal, torch.ones_like(area))
        return scene.on_gaussians(torch.where(scene.in_wind, torch.linalg.vector_norm(force, dim=-1), 0.0))

    def force_scale(self) -> float:
        """Force per area [Pa] that the wind's flow, without gusts, can exert on a patch at rest; 1 in still air."""
        speed = float(torch.linalg.vector_norm(self.flows(), dim=-1).amax())
        coefficients = float(torch.stack([self.aero.C_D, self.aero.C_F, self.aero.C_L]).abs().sum())
        return 0.5 * self.aero.air_density * speed**2 * coefficients or 1.0

    def flows(self) -> Tensor:
        """Flows of the wind without gusts [m/s], shape (K, 3); those of a spatial wind are at the particles."""
        if isinstance(self.wind, WindField):
            return self.wind.flows
        position = self.scene.points.position
        return self.wind_force.air(torch.zeros((), dtype=torch.float64, device=position.device), position)

    # ---- the run

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
            recorder: What to write from now on; the recorder of the constructor if None.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            SimulationDiverged: If the simulation diverges; everything recorded so far is saved first.
            ValueError: If the output cannot be written or resumed, or the camera lies inside the object.
        """
        self.recorder = recorder or self.recorder
        count = self.frames_wanted if frames is None else check_count("frames", frames)
        return run(self, Path(output), count, resume, dict(settings or {}), progress)
