"""The main entry point: a splat in the wind, frame by frame."""

from __future__ import annotations

import copy
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from gaussian_swaying._arguments import check_arguments
from gaussian_swaying._checks import check_frames, check_positive, check_vector
from gaussian_swaying._files import sha256
from gaussian_swaying._fixed import Fixed, changed
from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.config.parser import (
    NOT_COMPARED,
    applied,
    arguments_of,
    build_parser,
    check_settings,
    config_text,
    parse_file,
    python_text,
    scene_name,
    with_custom,
)
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.kernels.graphs import tensors_in
from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.contact import Contact
from gaussian_swaying.mpm.forces import Force, as_forces
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.recording.resume import packed_frames
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.rendering.cameras.camera_path import CameraPath
from gaussian_swaying.rendering.gsplat_renderer import load_kernels, loaded_before
from gaussian_swaying.rendering.protocol import Renderer
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.body import Material, SimulatedScene, with_parts
from gaussian_swaying.simulation.certificate import Certificate
from gaussian_swaying.simulation.draw import CopiesPainter, Frame, Painter, frames_from
from gaussian_swaying.simulation.measure import FrameDiagnostics, SimulationDiverged
from gaussian_swaying.simulation.model import (
    WIDER,
    Copy,
    DeviceLike,
    Edit,
    HoldLike,
    MaterialLike,
    Model,
    Normalisation,
    SceneLike,
    SolverLike,
    WindLike,
    as_camera,
    as_material,
    as_scene,
    as_solver,
    as_wind,
    resolve_device,
)
from gaussian_swaying.simulation.record import Run
from gaussian_swaying.simulation.step import Copies, SceneEditor, Stepper
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.field import SpatialWind, WindField
from gaussian_swaying.wind.force import AeroForce


def load_ahead(device: torch.device) -> Callable[[], None]:
    """Begin to load what a device needs, in a thread: its context, Triton's compiler and gsplat's kernels.

    Failures are ignored; the first use reports them. Nothing that takes long is compiled.

    Args:
        device: The device of a simulation; only a CUDA device needs anything.

    Returns:
        A function that waits for the end; call it before the device is used, as no other thread may use it while a
        graph is recorded.
    """
    if device.type != "cuda":
        return lambda: None
    current = torch.cuda.current_device() if torch.cuda.is_initialized() else 0  # a new thread begins with the first
    number = current if device.index is None else device.index
    thread = threading.Thread(target=_load, args=(number,), name="load-ahead")
    thread.start()
    return thread.join


def _load(number: int) -> None:
    for step in (
        lambda: torch.empty(1, device="cuda"),
        lambda: compiles("cuda"),
        lambda: loaded_before() and load_kernels(),
    ):
        with suppress(Exception), torch.cuda.device(number):
            step()


if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace
    from typing_extensions import Self


class Simulation(Fixed):
    """A splat in the wind. The constructor is the schema of the YAML; every component also works on its own.

    Positions and regions are given in scene units and axes; velocities, gravity and light in metres, z up. Threads that
    share a simulation take turns.

    Args:
        scene: The source of the Gaussians, and the choice of those that move. In Python also a file, Gaussians or a
            scene made in code; these are simulated as a whole, with the defaults of a :class:`Scene`.
        material: The material of the object; :class:`Material` with its defaults if None. In Python also the name of
            one of :data:`~gaussian_swaying.mpm.materials.MATERIALS`; a solver that is made then has its damping.
        solver: Grid, formulation, gravity and boundaries; if None, a grid of 32 cells along the longest side.
        wind: Air velocity over time; in Python also one that varies in space, or three numbers [m/s]. Still air if
            None.
        aero: Force of the wind on patches; :class:`AeroForce` with its defaults if None.
        air: Box in which the air is computed, with ``wind`` as its inflow; null for the wind as it is everywhere. See
            docs/air.md.
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
        copies: Copies of the object, each with a place, a turn and gusts of its own. They are simulated together,
            without touching each other, and drawn from the one splat at these places and nowhere else. Empty for the
            object alone. See docs/many.md.
        frame_dt: Time between frames [s].
        dtype: Precision of the solver.
        device: auto uses a CUDA GPU if there is one, else the CPU.
        up: Python only, if ``scene`` is not a :class:`Scene`: direction in the scene that points up.
        hold: Python only, if no solver is given: what is held in place. A region, or a pin with a kind of its own:
            ``PinnedRegion(region, kind="clamp")`` also holds the slope, ``PinnedPoints`` holds given places. Or
            a list of them, or ``auto`` for the end at which it seems to be held.
        renderer: Python only: draws the Gaussians; by default gsplat on CUDA and the torch renderer elsewhere.
        cloud: Python only: the Gaussians of ``scene.ply`` if they have been read already, or a part of them.

    Between frames ``wind``, ``aero``, ``custom_forces``, ``frame_dt`` and ``recorder`` may be assigned; :meth:`edit`
    and :meth:`change` change the material, and ``painter`` the pictures. For other arguments make another simulation.

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

    assignable, of_a_file = ("frames_wanted",), True

    def __init__(
        self,
        scene: SceneLike,
        material: MaterialLike | None = None,
        *,
        solver: SolverLike | None = None,
        wind: WindLike | None = None,
        aero: AeroForce | None = None,
        air: ComputedAir | None = None,
        contact: Contact | None = None,
        forces: list[Force] = [],  # noqa: B006  (never changed; the schema of the config shows it)
        shader: Shader | None = None,
        camera: CameraPath | None = None,
        cameras: dict[str, CameraPath] | None = None,
        edits: list[Edit] = [],  # noqa: B006
        recorder: Recorder | None = None,
        normalisation: Normalisation | None = None,
        background: list[float] = [0.0, 0.0, 0.0],  # noqa: B006
        copies: list[Copy] = [],  # noqa: B006
        frame_dt: float = 0.04,
        dtype: Literal["float32", "float64"] = "float32",
        device: DeviceLike = "auto",
        up: Sequence[float] | None = None,
        hold: HoldLike | None = None,
        renderer: Renderer | None = None,
        cloud: GaussianCloud | None = None,
    ) -> None:
        given = {name: value for name, value in locals().items() if name not in ("self", *NOT_COMPARED)}
        check_arguments(type(self).__init__, given | {"recorder": recorder, "cloud": cloud}, wider=WIDER)
        check_positive("frame_dt", frame_dt)
        colour = check_vector("background", background)
        target = resolve_device(device)
        wait_for_device = load_ahead(target)
        damping = known_material(material).damping if isinstance(material, str) else 0.0
        settings, material = as_scene(scene, up), as_material(material)
        cloud = settings.cloud() if cloud is None else cloud  # read once
        solver = as_solver(solver, hold, settings, cloud, damping)
        self._made_with: dict[str, Any] | None = given | {"solver": solver, "hold": None}
        if normalisation is not None:
            if hold is not None:
                raise ValueError("`hold` cannot be combined with `normalisation`: give a solver with the pins.")
            settings, material, solver, edits = normalisation.place(settings, material, solver, edits, cloud)
        field = None if settings.materials is None else settings.materials(cloud)
        material, solver = with_parts(settings, cloud, material, solver, field)
        apart = [
            part.region for part in (*solver.boundaries, *edits) if isinstance(getattr(part, "region", None), Region)
        ]
        fixed, kind = bool(solver.neighbours_fixed), getattr(torch, dtype)
        seen = SimulatedScene(settings, material, solver.dx, kind, cloud, fixed, apart, solver.embedded, field)
        if contact is not None and not fixed:
            raise ValueError(
                "`contact` needs `solver.formulation: total`: leave it out, as in `updated` material meets on the grid."
            )
        obstacles = [part for part in solver.boundaries if isinstance(part, Obstacle)]
        seen.take_contact(contact, obstacles)
        blowing = as_wind(wind, seen.frame)
        camera = as_camera(camera, cameras, blowing, seen)
        own = tuple(force.in_frame(seen.frame) for force in as_forces(forces))
        aero = aero or AeroForce()
        model = Model(seen, material, blowing, aero, own, solver.settings, solver, air, float(frame_dt))
        wait_for_device()
        placed = Copies(copies, model, solver) if copies else None
        self._stepper = Stepper(solver, model, copies=placed)
        drawing = (self._stepper, shader, camera, cameras, colour, renderer)
        self._painter = Painter(*drawing) if placed is None else CopiesPainter(*drawing)
        self.to(target)
        self._editor = SceneEditor(self._stepper, edits)
        self._recorder = self._recorder_or(recorder)
        self.frames_wanted = 250  # of a run; those of the file, if there is one
        self._files: list[Path] = []
        self._resumable: tuple[Path, int] | None = None
        self._text, self._given, self._first = "", given, self._running()

    def __repr__(self) -> str:
        return f"Simulation({self.scene}, {self.material}, {self.solver}, {self.wind}, {self.device})"

    # ---- parts

    @property
    def painter(self) -> Painter:
        """Draws the scene."""
        return self._painter

    @property
    def stepper(self) -> Stepper:
        """Advances the state."""
        return self._stepper

    @property
    def editor(self) -> SceneEditor:
        """Applies the edits."""
        return self._editor

    @property
    def scene(self) -> SimulatedScene:
        """Gaussians, material points and patches."""
        return self._stepper.scene

    @property
    def files(self) -> list[Path]:
        """The files that the last run wrote."""
        return self._files

    @property
    def resumable(self) -> tuple[Path, int] | None:
        """The checkpoint of the last run, and its frame."""
        return self._resumable

    @property
    def solver(self) -> Solver:
        """The solver."""
        return self._stepper.solver

    @property
    def turn(self) -> Turn:
        """The lock of the thread that steps or draws."""
        return self._stepper.turn

    @property
    def device(self) -> torch.device:
        """Device of the components."""
        return self._painter.device

    def to(self, device: torch.device | str) -> Self:
        """Move all components to a device; returns the simulation."""
        model = self.model
        for part in (self._painter, model.scene, self.solver, model.wind, model.aero, *model.forces):
            part.to(device)
        return self

    # ---- numbers that may change

    @property
    def model(self) -> Model:
        """The present scene, material and drivers; see :mod:`gaussian_swaying.simulation.model`."""
        return self._stepper.model

    @property
    def material(self) -> Material:
        """The material, without edits."""
        return self.model.material

    @property
    def wind(self) -> WindField | SpatialWind:
        """The wind; it may be assigned between two frames, also as three numbers [m/s]."""
        return self.model.wind

    @wind.setter
    def wind(self, wind: WindLike | None) -> None:
        self.adopt(self.model.replace(wind=as_wind(wind, self.scene.frame)))

    @property
    def aero(self) -> AeroForce:
        """Force of the wind on patches; it may be assigned between two frames."""
        return self.model.aero

    @aero.setter
    def aero(self, aero: AeroForce | None) -> None:
        check_arguments(Simulation.__init__, {"aero": aero})
        self.adopt(self.model.replace(aero=aero or AeroForce()))

    @property
    def custom_forces(self) -> tuple[Force, ...]:
        """Forces besides gravity and wind; they may be assigned between two frames."""
        return self.model.forces

    @custom_forces.setter
    def custom_forces(self, forces: Sequence[Force]) -> None:
        self.adopt(self.model.replace(forces=tuple(as_forces(forces))))

    @property
    def forces(self) -> list[Force]:
        """All forces besides gravity: the wind, unless it has no effect, and the custom forces."""
        return self._stepper.forces

    @property
    def frame_dt(self) -> float:
        """Time between frames [s]; it may be assigned between two frames."""
        return self.model.frame_dt

    @frame_dt.setter
    def frame_dt(self, frame_dt: float) -> None:
        self.change("frame_dt", frame_dt)

    @property
    def recorder(self) -> Recorder:
        """Outputs of :meth:`run`; it may be assigned."""
        return self._recorder

    @recorder.setter
    def recorder(self, recorder: Recorder | None) -> None:
        check_arguments(Simulation.__init__, {"recorder": recorder})
        self._recorder = self._recorder_or(recorder)

    def _recorder_or(self, recorder: Recorder | None) -> Recorder:
        if recorder is None and self._stepper.copies is not None:
            return Recorder(trajectory=False, nodes=False)
        return copy.copy(recorder or Recorder())

    @in_turn
    def change(self, name: str | Mapping[str, Any], value: Any = None) -> None:
        """Change a number between two frames: ``simulation.change("wind.speed", 3)``; it stays after another start.

        Args:
            name: A name of :mod:`gaussian_swaying.simulation.model`, such as ``material.E``; or several with their
                values.
            value: Its value.

        Raises:
            ValueError: If there is no such parameter, a value is out of range, or the simulation has no place for it;
                everything then stays as it was.
        """
        self.adopt(self.model.at(name, value))

    @in_turn
    def adopt(self, model: Model) -> None:
        """Continue with another model of the same scene; :meth:`change` does this for single numbers."""
        before, editor = self.model, self._editor
        if model.points is not before.points and editor.edits:
            raise ValueError("`edits` give the material of parts of the object: change it there, not everywhere.")
        try:
            self._adopt(model)
        except Exception:
            self._adopt(before)
            raise

    def _adopt(self, model: Model) -> None:
        editor, points = self._editor, model.points
        with torch.inference_mode(False):
            if points is not self.model.points and editor.unedited is not None:
                editor.unedited = changed(editor.unedited, points=points)
            self._stepper.take(model, running=self._stepper.starts > 0)

    def variant(self, values: Mapping[str, Any], recorder: Recorder | None = None, config: str = "") -> Simulation:
        """Another simulation of the same scene with other numbers; it shares Gaussians, cameras and pins.

        Args:
            values: Values as for :meth:`change`.
            recorder: Outputs of its runs.
            config: Its configuration as YAML.

        Raises:
            ValueError: As :meth:`change`.
        """
        other, model = copy.copy(self), self.model.replace(scene=self._editor.unedited or self.scene).at(values)
        model.wind.to(self.device)
        other._stepper = Stepper(self.solver.like(model.solver), model, turn=self.turn, copies=self._stepper.copies)
        other._painter = changed(self._painter, stepper=other._stepper)
        other._editor = SceneEditor(other._stepper, self._editor.edits)
        other._recorder, other._files = self._recorder_or(recorder), []
        other.config, other._made_with = config, None
        return other

    def batch(self, models: Sequence[Model]) -> Stepper:
        """Combine models of this scene, such as ``[model, model.at("wind.speed", 9)]``, to one rollout.

        Args:
            models: They may differ in wind and material.

        Raises:
            ValueError: If they cannot be a batch.
        """
        why = "they have `copies`, which are one already" if self._stepper.copies is not None else None
        why = "they have `edits`; put their material into `material`" if self._editor.edits else why
        if why is not None:
            raise ValueError(f"These cannot be simulated as a batch: {why}.")
        return Stepper(self.solver.like(models[0].solver), models, turn=self.turn)

    def _running(self) -> dict[str, tuple[object, list[object]]]:
        model, painter = self.model, self._painter
        parts = {name: getattr(model, name) for name in ("material", "wind", "aero", "forces", "air", "frame_dt")}
        parts |= {name: getattr(painter, name) for name in ("shader", "camera", "cameras", "background")}
        parts["solver"] = self.solver
        found: dict[str, tuple[object, list[object]]] = {}
        for name, part in parts.items():
            held = list(part.items()) if isinstance(part, dict) else [part]
            held = list(part) if isinstance(part, tuple) else held
            tensors = (
                [part] if isinstance(part, Tensor) else tensors_in(one for one in held if isinstance(one, nn.Module))
            )
            marks = [*held, *([model.solver] if name == "solver" else [])]
            found[name] = part, [*marks, *(0 if one.is_inference() else one._version for one in tensors)]
        return found

    @property
    def config(self) -> str:
        """The complete configuration as YAML, with arguments from Python and later changes; runs resume by it."""
        heading = "changed_in_python" if self._text else "made_in_python"
        return self._text + python_text(heading, self._given | self._changes())

    @config.setter
    def config(self, text: str) -> None:
        self._text, self._given, self._first = text, {}, self._running()

    def _changes(self) -> dict[str, object]:
        """The parts that were changed since the simulation was made."""
        found: dict[str, object] = {}
        for name, (part, marks) in self._running().items():
            first = self._first[name][1]
            if len(first) != len(marks) or not all(map(_same, first, marks)):
                found[name] = part
        return found

    def on_grid(self, ratio: float) -> Simulation:
        """The simulation made again, on cells ``ratio`` times as large.

        Raises:
            ValueError: If it was changed since it was made, or cannot be simulated on that grid.
        """
        if self._changes():
            changes = ", ".join(f"`{name}`" for name in self._changes())
            raise ValueError(f"{changes} changed after the simulation was made: make it with the new values instead.")
        if self._made_with is None:
            raise ValueError("A variant cannot be made on another grid: make a simulation with its values instead.")
        solver = self._made_with["solver"]
        coarser = solver.like(replace(solver.settings, dx=ratio * solver.dx))
        return type(self)(**self._made_with | {"solver": coarser, "device": self.device})

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
        settings = applied(settings)
        text = config_text(parser, settings)
        parts: Any = with_custom(parser, settings, parser.instantiate(settings))
        simulation = cls(**{name: parts.get(name) for name in arguments_of(cls)} | changes)
        simulation.config = text
        simulation._given = {name: value for name, value in changes.items() if name not in NOT_COMPARED}
        simulation.frames_wanted = settings.frames
        return simulation

    # ---- frames

    @in_turn
    def start(self) -> State:
        """The state at rest at time zero, with the edits of that time applied.

        Raises:
            ValueError: If a pin holds nothing, the grid is too large or a fixed substep is too long, now or after one
                of the edits; if the material is so stiff that rounding shakes it.
        """
        return self._editor.start()

    @in_turn
    def advance(self, state: State) -> tuple[State, FrameDiagnostics]:
        """Advance by one frame; see :meth:`Stepper.advance <gaussian_swaying.simulation.step.Stepper.advance>`."""
        return self._stepper.advance(state)

    @in_turn
    def edit(self, state: State, *edits: Edit) -> State:
        """Change material or colour now, between two frames; the time of the edits is ignored.

        The solver is set up again for the new material, including its kernels and CUDA graphs. Positions, velocities
        and deformations stay, so momentum changes with the mass and elastic energy with the stiffness.

        Args:
            state: The current state.
            edits: The changes, in this order.

        Raises:
            ValueError: If a region contains nothing, or a plastic law is used in the ``total`` formulation.
        """
        return self._editor.edit(state, edits)

    @in_turn
    def frames(self, count: int) -> Iterator[Frame]:
        """Simulate from rest, frame by frame. Timed edits act between frames, as in :meth:`run`.

        Anything assigned between two frames, such as another ``wind``, applies from the next frame on.

        Args:
            count: Number of frames; the first is the state at rest.

        Returns:
            The frames. Read a frame before the next one: an edit changes the scene for all of them. One loop at a time,
            in whatever thread: starting again ends the loop before.

        Raises:
            SimulationDiverged: If the simulation diverges.
            ValueError: As in :meth:`start`.
        """
        check_frames("count", count)
        return frames_from(self._painter, self._editor, self.start(), 0, count)

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
        certify: bool = False,
    ) -> dict[str, Any]:
        """Simulate, render and record, as ``gaussian-swaying sim`` does.

        Args:
            output: Folder of the results.
            frames: Number of frames; the first is the state at rest; those of the file, or 250, if None.
            resume: Continue the run found in ``output`` after its last complete frame.
            settings: Additional entries for the summary.
            progress: Show a progress bar.
            recorder: Outputs from now on; the recorder of the constructor if None.
            certify: Also run on a coarser grid, and there with other substeps, which takes as long again, and add the
                error of the places, see :mod:`~gaussian_swaying.simulation.certificate`.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            SimulationDiverged: If the simulation diverges; everything recorded so far is saved first.
            ValueError: If the output cannot be written or resumed, or the camera lies inside the object.
        """
        self._recorder = self._recorder if recorder is None else self._recorder_or(recorder)
        count = self.frames_wanted if frames is None else check_frames("frames", frames)
        if certify and resume:
            raise ValueError("`certify` needs all frames of a run: leave out `resume`.")
        certificate = Certificate(self, count) if certify else None
        run = Run(self._painter, self._editor, self._recorder, count, self.config, certificate)
        self._resumable = None
        try:
            return run.whole(Path(output), resume, dict(settings or {}), progress)
        finally:
            self._files, frame = run.files, self._recorder.checkpoint_frame
            if frame is not None:
                self._resumable = (self._recorder.folder / "checkpoint.pt", frame)


def _same(before: object, now: object) -> bool:
    return before is now or (isinstance(now, int | float) and before == now)


@torch.inference_mode()
def run_batch(
    members: Sequence[Simulation], folders: Sequence[Path | None], frames: int, settings: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any] | None]:
    """Simulate, draw and record simulations of one scene together, as ``Simulation.run`` does for one.

    There are no checkpoints: what is interrupted starts again.

    Args:
        folders: Folder of each; None for one that is only simulated.
    """
    batch = members[0].batch([member.model for member in members])
    state = batch.start()
    opened, runs = [], dict[int, Run]()
    try:
        for index, (member, folder) in enumerate(zip(members, folders, strict=True)):
            if folder is not None:
                cameras = tuple(member.painter.cameras)
                member.recorder.open(folder, member.config, False, 1 / batch.frame_dt, cameras, alone=False)
                opened.append(member.recorder)
                runs[index] = Run(member.painter, member.editor, member.recorder, frames, member.config)
        begin = time.perf_counter()
        if batch.device.type == "cuda" and frames > 1:  # compiles the kernels; the real frame reports an error
            with suppress(SimulationDiverged):
                batch.advance(state)
        startup = (time.perf_counter() - begin) / len(members)
        begin = time.perf_counter()
        each = batch.at_first(state).each()
        for frame in range(frames):
            launched = batch.launch(state) if frame + 1 < frames else None
            for index, run in runs.items():
                if run.recording:
                    run.record(state.scene(index), frame)
                run.log.append(each[index].as_dict())
            if launched is not None:
                state, _ = launched.finish()
                each = launched.each
        for recorder in opened:
            recorder.wait()
        seconds = (time.perf_counter() - begin) / len(members)
        found: list[dict[str, Any] | None] = [None] * len(members)
        for index, run in runs.items():
            drawn = sum(value for part, value in run.walls.read(wait=True).items() if part != "writing")
            run.walls.seconds["simulation"] = max(seconds - drawn, 0.0)  # its share of what they took together
            run.walls.seconds["startup"] = startup
            found[index] = run.close("complete", None, state.scene(index), frames, dict(settings[index]))
        return found
    finally:
        for recorder in opened:
            recorder.release()


class RecordedRun:
    """A recorded run: its motion, and a simulation rebuilt from its configuration and splat.

    Args:
        folder: The output folder of ``gaussian-swaying sim``.

    Attributes:
        simulation: Made again, on the CPU.
        summary: The summary of the run.

    Raises:
        ValueError: If there is no run, its splat is missing or another one, or it was made from Python.

    Example:
        >>> for gaussians in RecordedRun("outputs/flag").frames():  # doctest: +SKIP
        ...     print(gaussians.means.mean(0))
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.summary = self._summary()
        self.simulation, self.name = self._simulation()

    def _summary(self) -> dict[str, Any]:
        path = self.folder / "summary.json"
        if not path.is_file() or not (self.folder / "config.yaml").is_file():
            raise ValueError(f"{self.folder} has no run: give the output folder of `gaussian-swaying sim`.")
        try:
            summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            summary["formulation"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} cannot be read ({error}): run the simulation again.") from error
        return summary

    def _simulation(self) -> tuple[Simulation, str]:
        config, parser = self.folder / "config.yaml", Simulation.parser()
        try:
            settings = parse_file(parser, config)
        except ValueError as error:
            python = "made_in_python" in config.read_text(encoding="utf-8", errors="replace")
            why = "the run was made from Python" if python else str(error).rstrip(".")
            raise ValueError(f"{config} cannot be read ({why}): run the simulation again from a file.") from error
        splat = settings.scene.ply
        if splat is not None:
            if not Path(splat).is_file():
                raise ValueError(
                    f"The splat {splat} of the run is not there (`scene.ply` in {config}): put it back, or export from "
                    "the folder in which the run was started."
                )
            if self.summary.get("splat_sha256") not in (None, sha256(Path(splat))):
                raise ValueError(
                    f"The splat {splat} has changed since the run in {self.folder}: restore it, or run again."
                )
        return Simulation.from_settings(parser, settings, device="cpu"), scene_name(settings)

    @cached_property
    def start(self) -> Any:
        """The state at rest; raises the errors of :meth:`Simulation.start`."""
        return self.simulation.start()

    def nodes(self) -> tuple[Tensor, Tensor]:
        """Flat indices (M,) of the recorded nodes in the grid of :attr:`start`, and their displacements [m] (K, M, 3).

        Raises:
            ValueError: If the run has none, or those of another version of the program.
        """
        path, formulation = self.folder / "nodes.npz", self.summary["formulation"]
        if formulation not in ("total", "modes"):
            raise ValueError(
                f"The run in {self.folder} is of `solver.formulation: {formulation}`, where nodes do not move with the "
                "material: a film needs a run of `total`."
            )
        if not path.is_file():
            raise ValueError(f"The run in {self.folder} has no nodes.npz: run it again with `recorder.nodes: true`.")
        displacement, nodes = load_nodes(path), self.simulation.scene.follow.nodes(self.start)
        assert nodes is not None  # the run is of `total`
        if displacement.shape[1] != len(nodes):
            raise ValueError(
                f"{path} has {displacement.shape[1]:,} nodes, but the scene of {self.folder / 'config.yaml'} has "
                f"{len(nodes):,}: export with the version of this program that made the run, or run it again."
            )
        return nodes, displacement

    @torch.inference_mode()
    def frames(self) -> Iterator[DeformedGaussians]:
        """All Gaussians in each frame, from ``nodes.npz`` or the trajectory.

        Their colours are those of the edits so far, so read them before the next frame.
        Displacements have the precision of the file: float16, 0.05 % of each, up to half of the object's size.

        Raises:
            ValueError: If the run recorded no motion.
        """
        states, editor = self._states(), self.simulation.editor
        step = self.simulation.frame_dt
        for frame, state in enumerate(states):
            editor.apply(editor.due((frame + 1e-3) * step), flowed=frame > 0)
            yield editor.scene.deformed(state)

    def _states(self) -> Iterator[Any]:
        start, trajectory = self.start, self.folder / "trajectory.npz"
        if (self.folder / "nodes.npz").is_file():
            nodes, displacement = self.nodes()
            rest = torch.zeros_like(start.node_displacement)
            for row in displacement.to(rest.dtype):
                yield replace(start, node_displacement=rest.index_copy(0, nodes, row))
        elif self.simulation.scene.track is None and trajectory.is_file():
            for frame in sorted(packed_frames(trajectory)):
                position, F = (part.to(start.position.dtype) for part in load_trajectory(trajectory, frame))
                yield SimpleNamespace(position=position, F_total=F)
        else:
            name = "trajectory" if self.simulation.scene.track is None else "nodes"
            raise ValueError(
                f"The run in {self.folder} has no {name}.npz, which moves the Gaussians: run it again with "
                f"`recorder.{name}: true`."
            )


@dataclass(frozen=True)
class Roles:
    """Masks of Gaussians, shape (N,).

    Attributes:
        simulated: Those selected by region and opacity.
        carried: Faint and loose ones that follow them.
        pinned: Simulated ones that a condition holds.
        pushed: Simulated ones that an impulse pushes.
        names: The kind of each condition and the number of its particles, in words.
    """

    simulated: Tensor
    carried: Tensor
    pinned: Tensor
    pushed: Tensor
    names: list[str]


def classify(simulation: Simulation) -> Roles:
    """Sort the Gaussians into simulated, carried, held and pushed ones."""
    scene = simulation.scene
    simulated, carried, pinned, pushed = (torch.zeros(len(scene.model.means), dtype=torch.bool) for _ in range(4))
    index = scene.simulated.cpu()
    carried[scene.carried.cpu()] = True
    simulated[index], carried[index] = True, False
    where = scene.frame.point_to_sim(scene.model.means.detach()[scene.simulated].double()).to(
        scene.points.position.dtype
    )
    names = []
    for boundary in conditions(simulation):
        moved = boundary.in_frame(scene.frame)
        mask = moved.particle_mask(scene.points.position)
        name = type(boundary).__name__
        if mask is None:
            names.append(name)
            continue
        own = moved.particle_mask(where)
        assert own is not None
        (pushed if boundary.pinned_share is None else pinned)[index[own.cpu()]] = True
        names.append(f"{name}: {int(mask.sum()):,} particles")
    return Roles(simulated, carried, pinned, pushed, names)


def conditions(simulation: Simulation) -> list[Boundary]:
    """The boundary conditions of a run, in scene units."""
    return [b for b in simulation.solver.boundaries if isinstance(b, Boundary)]
