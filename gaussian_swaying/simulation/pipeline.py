"""The whole run: wind, solver, shading, rendering and recording, frame by frame."""

from __future__ import annotations

import math
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

import gaussian_swaying
from gaussian_swaying._checks import check_positive
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import SpatialWind, WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.gaussians.ply import GaussianCloud, write_ply
from gaussian_swaying.gaussians.surface import DeformedGaussians, covariance_to_quat_scale, deform_patch
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.rendering import passes
from gaussian_swaying.rendering.base import Renderer, RenderOutput, make_renderer
from gaussian_swaying.rendering.camera import Camera
from gaussian_swaying.rendering.camera_path import CameraPath
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation import signals
from gaussian_swaying.simulation.checkpoint import check_state, unreadable
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    SimulationDiverged,
    TearingGauge,
    check_spacing,
    diagnose,
    measure,
)
from gaussian_swaying.simulation.edits import Edit, SceneEditor
from gaussian_swaying.simulation.health import advice, extremes
from gaussian_swaying.simulation.progress import RunProgress
from gaussian_swaying.simulation.recorder import Recorder, check_camera_name, frame_folder
from gaussian_swaying.simulation.scene import SimulatedScene
from gaussian_swaying.simulation.seal import sha256

MAX_RETRIES = 4
CFL_LIMIT = 0.5  # an adaptive frame that exceeds it is done again with shorter substeps
CFL_SAMPLES = 8  # how often a frame is looked at, as material may stiffen and slacken again within it
MAX_CFL = 2.0  # above it, waves cross more than two cells in a substep and nothing is stable
MAX_WIND = 1e6  # m/s; any more is a mistake, and would overflow positions
MAX_GROWTH = 1000  # a frame that takes this many times the substeps of the first is past saving
MAX_SUBSTEPS = 1_000_000  # in a frame: hours of a processor, and minutes of the fastest GPU
MAX_PIXELS = 1 << 26  # of a picture: twice those of 8K
MAX_LOOKS = 2_000  # how many frames' cameras are looked at before a run


class SimulationPipeline(nn.Module):
    """Composes the components into frames; every component can be used without it.

    Args:
        scene: Gaussians, material points and patches.
        solver: Moves the material; its boundaries are given in scene units.
        wind: Air velocity over time, the same everywhere or not.
        aero: Force of the wind on patches.
        shader: Colours from normals and light; None leaves the colours of the splat.
        camera: Where each frame is seen from.
        background: Background colour, in [0, 1].
        frame_dt: Time between frames [s].
        device: Where to run.
        renderer: Draws the Gaussians; by default gsplat on CUDA and the torch renderer elsewhere.
        cameras: Further cameras by name, each with pictures and videos of its own.
        edits: Changes of material or colour, at load or during the run.
    """

    def __init__(
        self,
        scene: SimulatedScene,
        solver: MPMSolver,
        wind: WindField | SpatialWind,
        aero: AeroForce,
        shader: Shader | None,
        camera: CameraPath,
        background: tuple[float, ...] = (0.0, 0.0, 0.0),
        frame_dt: float = 0.04,
        device: torch.device | str = "cpu",
        renderer: Renderer | None = None,
        cameras: Mapping[str, CameraPath] | None = None,
        edits: Sequence[Edit] = (),
    ) -> None:
        super().__init__()
        check_positive("frame_dt", frame_dt)
        if not all(0 <= value <= 1 for value in background):
            raise ValueError(f"Expected `background` within [0, 1], but got {list(background)}: 1 is white, not 255.")
        self.scene, self.solver, self.wind, self.aero, self.shader = scene, solver, wind, aero, shader
        self.camera, self.cameras, self.frame_dt = camera, dict(cameras or {}), float(frame_dt)
        for name in self.cameras:
            check_camera_name(name)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32))
        self.background: Tensor
        self.to(device)
        self.editor = SceneEditor(scene, edits)
        self.renderer = renderer if renderer is not None else make_renderer(self.device)
        self._most_substeps = MAX_SUBSTEPS
        self._progress: RunProgress | None = None
        self.files: list[Path] = []  # what the last run wrote
        self.resumable: tuple[Path, int] | None = None  # the checkpoint of the last run, and its frame
        self._wind_force: list[WindForce] = []  # in a list, as it is no part of the module's state
        self._wind_parts: tuple[object, ...] = ()
        self.idle = self.aero.idle  # asked once, as it makes the host wait
        self._force_end = self.force_scale()  # likewise
        self._tearing: TearingGauge | None = None

    @property
    def device(self) -> torch.device:
        """Where the components are."""
        return self.background.device

    # ---- simulation

    def start(self) -> MPMState:
        """The state at rest, time zero, with the edits of that time.

        Raises:
            ValueError: If a pin holds nothing, the grid is too large or a fixed substep is too long, now or after one
                of the edits.
        """
        editor, frame = self.editor, self.scene.frame
        editor.reset()
        for later in (moment for moment in editor.times if moment > 0):  # what they make impossible is refused now
            self._edit(editor.due(0.0))
            self._edit(editor.due(later), flowed=True)
            rehearsed = self.solver.init_state(self.scene.points, frame=frame)
            self.solver.fused()
            self.solver.substeps(rehearsed, self.frame_dt)
        editor.reset()
        self._edit(editor.due(0.0))
        state = self.solver.init_state(self.scene.points, frame=frame)
        self.idle, self._force_end = self.aero.idle, self.force_scale()
        check_spacing(self.solver)
        self.solver.fused()  # what its kernels refuse is refused here
        at_rest = self.solver.substeps(state, self.frame_dt)
        if at_rest > MAX_SUBSTEPS:
            remedy = "soften it (`material.E`, `material.nu`), raise its density or `solver.dx`, or shorten `frame_dt`"
            if self.solver.substep is not None:
                remedy = "raise `solver.substep`, set it to null for the longest that is stable, or shorten `frame_dt`"
            raise ValueError(
                f"A frame of {self.frame_dt:g} s would take {at_rest:,} substeps with this material and grid, more "
                f"than the {MAX_SUBSTEPS:,} that are of use: {remedy}."
            )
        self._most_substeps = min(MAX_GROWTH * at_rest, MAX_SUBSTEPS)
        self._tearing = None if self.solver.total_lagrangian else TearingGauge(self.solver)
        return state

    def edit(self, state: MPMState, *edits: Edit) -> MPMState:
        """Change material or colour now, between two frames; the time of the edits is not looked at.

        The solver takes the material anew, and with it its kernels and CUDA graphs. Positions, velocities and
        deformations stay, so momentum changes with the mass and elastic energy with the stiffness.

        Args:
            state: The state now.
            edits: What to change, in this order.

        Returns:
            The state with which the run goes on.

        Raises:
            ValueError: If a region holds nothing, or a law flows in the ``total`` formulation.
        """
        return self._take(state, self._edit(edits, flowed=True))

    def _edit(self, edits: Sequence[Edit], flowed: bool = False) -> Tensor | None:
        """Change the scene; which particles (P,) have another law then, None if the material is the same."""
        changed = [self.editor.apply(edit, flowed) for edit in edits]
        changed = [part for part, edit in zip(changed, edits, strict=True) if edit.of_material]
        return torch.stack(changed).any(0) if changed else None

    def _take(self, state: MPMState, changed: Tensor | None) -> MPMState:
        """Bind the solver to the material of the scene; ``changed`` as of :meth:`_edit`."""
        if changed is None:
            return state
        start = self.solver.init_state(self.scene.points, frame=self.scene.frame).internal
        if start is not None and state.internal is not None:
            start = torch.where(changed, start, state.internal)
        state = state.replace(internal=start)
        self.solver.fused()
        self._most_substeps = max(
            self._most_substeps, min(MAX_GROWTH * self.solver.substeps(state, self.frame_dt), MAX_SUBSTEPS)
        )
        if self._tearing is not None:
            elastic = self.solver.laws.elastic_particles()
            if elastic is not None:  # what has flowed apart before is no tear
                self._tearing.elastic = elastic if self._tearing.elastic is None else elastic & self._tearing.elastic
        return state

    def _edit_due(self, state: MPMState, resumed: bool = False) -> MPMState:
        """The state after the edits up to its time; a resumed state has seen them already."""
        edits = self.editor.due(float(state.time) + 1e-3 * self.frame_dt)
        edited = self._take(state, self._edit(edits, flowed=True))
        return state if resumed else edited

    @property
    def wind_force(self) -> WindForce:
        """The wind on the patches of the scene."""
        parts = (self.aero, self.wind, self.scene.patch_normal, self.scene.patch_area)
        if not self._wind_force or any(a is not b for a, b in zip(parts, self._wind_parts, strict=True)):
            self._wind_force, self._wind_parts = [WindForce(*parts)], parts
        return self._wind_force[0]

    @property
    def forces(self) -> list[Force]:
        """What pushes the particles besides gravity: the wind, unless it has no effect."""
        return [] if self.idle else [self.wind_force]

    def advance(self, state: MPMState) -> tuple[MPMState, FrameDiagnostics]:
        """Advance by one frame.

        A frame whose material stiffened so much that its substep was too long is thrown away and done again with a
        shorter one; so is one in which a particle outran the grid of the ``updated`` formulation, on a larger grid.

        Args:
            state: The state at the start of the frame.

        Returns:
            The state at its end, and its diagnostics.

        Raises:
            SimulationDiverged: If the frame does not end well.
        """
        margin = 0
        try:
            steps = self._substeps(state)
            for retry in range(MAX_RETRIES + 1):
                if steps > self._most_substeps:
                    cause = f"a frame would take {steps:,} substeps, and {self._most_substeps:,} are the most"
                    self._give_up(state, cause, "weaken the wind or the boundary that drives the particle")
                end, courant = self._roll(self.solver.fit_grid(state, self.frame_dt, margin), steps)
                work = (end.work - state.work).sum()
                # everything is under way before the host waits for the first time
                health = measure(self.solver, end, steps, courant, work, self._tearing)
                outran = (end.lost & ~state.lost & torch.isfinite(end.position).all(-1)).any()
                cfl, outrun = torch.stack([courant.double(), outran.double()]).tolist()
                too_long = self.solver.substep is None and not cfl <= max(CFL_LIMIT, 1.25 * self.solver.cfl)
                if retry == MAX_RETRIES or not (outrun or too_long):
                    break
                if outrun:
                    margin = 4 * max(margin, 4)
                if too_long:
                    growth = cfl / self.solver.cfl if math.isfinite(cfl) else 4.0
                    steps = int(steps * min(growth * 1.1, 4.0)) + 1
        except (FloatingPointError, ValueError) as error:
            # a fixed substep that became too long, a grid that grew beyond its limit, a position that is NaN
            self._give_up(state, str(error).rstrip("."))
        measured = health.read(check=True)
        if not cfl <= MAX_CFL:
            self._give_up(
                end, f"the Courant number of the frame is {cfl:.3g}, and above {MAX_CFL:g} no substep is stable"
            )
        return end, measured

    def _give_up(self, state: MPMState, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise SimulationDiverged, blaming the particle with the largest deformation."""
        particle = int(state.F_elastic.square().sum((-1, -2)).reshape(-1).argmax())
        if remedy is None:
            field = "solver.cfl" if self.solver.substep is None else "solver.substep"
            remedy = f"lower `{field}`, or weaken the wind or the boundary that drives it"
        raise SimulationDiverged(float(state.time), particle, cause, remedy)

    def _substeps(self, state: MPMState) -> int:
        return max(self.solver.substeps(state, self.frame_dt), self._drag_substeps(state))

    def _roll(self, state: MPMState, steps: int) -> tuple[MPMState, Tensor]:
        """The state some substeps later, and the largest Courant number on the way."""
        progress = self._progress
        watch = None if progress is None else lambda done: progress.substep(done, steps)
        return self.solver.watched_rollout(state, self.frame_dt / steps, steps, self.forces, CFL_SAMPLES, watch)

    def _drag_substeps(self, state: MPMState) -> int:
        """Substeps that keep explicit drag on light patches stable."""
        if self.idle:
            return 1
        winds = self.wind_force.samples(state, self.frame_dt / 4, 5)
        wind = torch.linalg.vector_norm(winds, dim=-1).amax().to(state.velocity.dtype)
        speed = wind + torch.linalg.vector_norm(state.velocity, dim=-1)
        fastest = self.aero.rate(speed, self.scene.patch_area, self.solver.points.mass).amax()
        rate, blowing = torch.stack([fastest.double(), wind.double()]).tolist()
        if not (math.isfinite(rate) and blowing < MAX_WIND):
            cause = f"the wind of {blowing:.3g} m/s, or its drag, is NaN or infinite or beyond {MAX_WIND:g} m/s"
            self._give_up(state, cause, "check the flow and the modulations of the wind")
        return 1 if self.aero.drag_step == "semi_implicit" else int(rate * self.frame_dt) + 1

    # ---- picture

    def camera_at(self, frame: int, name: str = "") -> Camera:
        """The camera of a frame, on the device and in the precision of the Gaussians; one copy, which nobody awaits.

        Args:
            frame: Frame number.
            name: Which of ``cameras``; empty for ``camera``.
        """
        return self._camera(frame, name).to(self.device, self.scene.model.means.dtype)

    def _camera(self, frame: int, name: str = "") -> Camera:
        """The camera of a frame, in float64 on the host."""
        scene, path = self.scene, self.cameras[name] if name else self.camera
        return path(frame, frame * self.frame_dt, scene.center, scene.frame.rotation[2], scene.size)

    def check_camera(self, frame: int) -> None:
        """Raise ValueError if a camera of a frame lies inside the box of the object at rest, or has too many pixels.

        The first is not asked of cameras of a capture, which stood where they stood: around an object or in a room.
        """
        low, high = self.scene.bounds
        for name, path in {"": self.camera, **self.cameras}.items():
            camera, field = self._camera(frame, name), f"cameras.{name}" if name else "camera"
            if camera.width * camera.height > MAX_PIXELS:
                raise ValueError(
                    f"A picture of {camera.width:,} x {camera.height:,} pixels is too large, {MAX_PIXELS:,} are the "
                    f"most: lower `{field}.init_args.width` and `height`."
                )
            if path.captured:
                continue
            eye = camera.position.to(low)
            if bool(((eye > low) & (eye < high)).all()):
                raise ValueError(
                    f"The camera at {[round(v, 3) for v in eye.tolist()]} lies inside the object, whose box reaches "
                    f"from {[round(v, 3) for v in low.tolist()]} to {[round(v, 3) for v in high.tolist()]} (scene "
                    f"units): move it out with `{field}.init_args.radius` or `eye`."
                )

    def colors(self, gaussians: DeformedGaussians, camera: Camera) -> Tensor:
        """Shaded colours, shape (N, 3): harmonics seen from the rest frame of each patch, times the shading."""
        scene = self.scene
        view = torch.nn.functional.normalize(gaussians.means - camera.position.to(gaussians.means), dim=-1)
        at_rest = (view[..., None] * gaussians.rotations).sum(-2) if scene.model.view_dependent else view
        colours = scene.model.colors(at_rest)
        if self.shader is None:
            return colours
        index = scene.moving
        parts = (colours, gaussians.normals, view)
        if not scene.all_move:
            parts = (colours[index], gaussians.normals[index], view[index])
        normal, to_eye = (scene.frame.direction_to_sim(part) for part in (parts[1], -parts[2]))
        shaded = self.shader(parts[0], normal, rest_normal=scene.rest_facing, view_direction=to_eye)
        return shaded if scene.all_move else colours.index_copy(0, index, shaded)

    def shade(self, state: MPMState, camera: Camera) -> tuple[DeformedGaussians, Tensor]:
        """Deformed Gaussians in scene units and their colours (N, 3)."""
        gaussians = self.scene.deformed(state, rotations=self.scene.model.view_dependent)
        return gaussians, self.colors(gaussians, camera)

    def draw(self, gaussians: DeformedGaussians, colours: Tensor, camera: Camera) -> RenderOutput:
        """Draw Gaussians given in scene units."""
        opacity = self.scene.model.opacity()
        return self.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera, self.background)

    def render(self, state: MPMState, frame: int) -> RenderOutput:
        """The picture of a state from the camera of a frame."""
        camera = self.camera_at(frame)
        gaussians, colours = self.shade(state, camera)
        return self.draw(gaussians, colours, camera)

    def wind_pressure(self, state: MPMState) -> Tensor:
        """Force of the wind per area of the patches as they are now [Pa], shape (P,); 0 for what feels no wind."""
        area = self.scene.patch_area
        if self.idle:
            return torch.zeros_like(area)
        normal, _ = deform_patch(state.F_total, self.scene.patch_normal, area)
        wind = self.wind_force.air(state.time, state.position)
        force = self.aero(wind, state.velocity, normal, torch.ones_like(area))
        return torch.where(area > 0, torch.linalg.vector_norm(force, dim=-1), 0.0)

    def force_scale(self) -> float:
        """Force per area [Pa] that the wind's flow, without gusts, can exert on a patch at rest; 1 in still air."""
        speed = float(torch.linalg.vector_norm(self.flows(), dim=-1).amax())
        coefficients = float(torch.stack([self.aero.C_D, self.aero.C_F, self.aero.C_L]).abs().sum())
        return 0.5 * self.aero.air_density * speed**2 * coefficients or 1.0

    def flows(self) -> Tensor:
        """Flows of the wind without gusts [m/s], shape (K, 3); of one that depends on the place, at the particles."""
        if isinstance(self.wind, WindField):
            return self.wind.flows
        position = self.scene.points.position
        return self.wind_force.air(torch.zeros((), dtype=torch.float64, device=position.device), position)

    def draw_normals(self, gaussians: DeformedGaussians, camera: Camera, axes: str = "camera") -> Tensor:
        """Picture of the normals, see :func:`~gaussian_swaying.rendering.passes.normal_colors`, shape (H, W, 3).

        Args:
            gaussians: In scene units.
            camera: The camera, on the device of the Gaussians.
            axes: ``camera`` (x right, y up, z towards the camera) or ``world`` (z up).
        """
        normals = passes.facing(gaussians.normals, gaussians.means - camera.position.to(gaussians.means))
        picture = self._draw(gaussians, normals, camera)
        if axes == "world":
            rotation = self.scene.frame.direction_to_sim(self.scene.identity).mT  # its rows are the scene's axes
        else:
            rotation = torch.cat([camera.world_to_camera[:1, :3], -camera.world_to_camera[1:3, :3]])
        return passes.normal_colors(picture.color, picture.alpha, rotation)

    def draw_force(self, state: MPMState, gaussians: DeformedGaussians, camera: Camera, largest: float) -> Tensor:
        """Picture of :meth:`wind_pressure`, its colours ending at ``largest`` [Pa], shape (H, W, 3)."""
        pressure = self.scene.on_gaussians(self.wind_pressure(state))
        picture = self._draw(gaussians, pressure[:, None].expand(-1, 3), camera)
        return passes.scalar_colors(picture.color[..., 0], picture.alpha, largest)

    def _draw(self, gaussians: DeformedGaussians, values: Tensor, camera: Camera) -> RenderOutput:
        """Blend any three numbers of each Gaussian."""
        return self.renderer(gaussians.means, gaussians.covariances, self.scene.model.opacity(), values, camera)

    def cloud(self, gaussians: DeformedGaussians) -> GaussianCloud:
        """Deformed Gaussians in storage form, harmonics turned with the patches."""
        from gaussian_swaying.gaussians.spherical_harmonics import rotate_sh

        cloud = self.scene.model.to_cloud()
        quats, scales = covariance_to_quat_scale(gaussians.covariances)
        return GaussianCloud(
            means=gaussians.means,
            quats=quats,
            scales=scales,
            opacities=cloud.opacities,
            sh=rotate_sh(cloud.sh, gaussians.rotations),
            normals=gaussians.normals,
        )

    def export(self, gaussians: DeformedGaussians, path: Path) -> None:
        """Write deformed Gaussians as a 3DGS .ply that any splat viewer opens, harmonics turned with the patches."""
        write_ply(path, self.cloud(gaussians))

    # ---- the run

    @torch.inference_mode()
    def run(
        self,
        recorder: Recorder,
        output: str | Path,
        frames: int,
        config: str = "",
        resume: bool = False,
        settings: dict[str, Any] | None = None,
        progress: bool = True,
    ) -> dict[str, Any]:
        """Simulate, render and record.

        Args:
            recorder: Writes the results.
            output: Folder for them.
            frames: Number of frames, the first one the state at rest.
            config: The whole configuration as YAML, kept with the results.
            resume: Continue the run found in ``output`` after its last complete frame.
            settings: Further entries for the summary.
            progress: Show a progress bar.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            SimulationDiverged: After everything recorded so far was saved.
            ValueError: If the output cannot be written or resumed, or the camera lies inside the object.
        """
        check_positive("frames", frames)
        for look in range(min(frames, MAX_LOOKS)):  # all of them, unless there are very many
            self.check_camera(look * (frames - 1) // max(min(frames, MAX_LOOKS) - 1, 1))
        state = self.start()  # what is refused is refused before anything is written
        splat = self._splat()

        def check(checkpoint: dict[str, Any]) -> None:
            self._check_checkpoint(checkpoint, state, Path(output), frames, splat)

        self.resumable = None
        checkpoint = recorder.open(output, config, resume, 1 / self.frame_dt, tuple(self.cameras), check)
        try:
            return self._run(recorder, frames, config, settings, progress, state, checkpoint, splat)
        finally:
            if recorder.checkpoint_frame is not None:
                self.resumable = (recorder.folder / "checkpoint.pt", recorder.checkpoint_frame)
            recorder.release()

    def _splat(self) -> str | None:
        """Checksum of the splat's file, which tells it from another one of the same name."""
        path = self.scene.source
        return None if path is None else sha256(Path(path))

    def _check_checkpoint(
        self, checkpoint: dict[str, Any], start: MPMState, output: Path, frames: int, splat: str | None
    ) -> None:
        """Raise ValueError unless the run can go on from a checkpoint as if it had never stopped."""
        held = checkpoint["state"].get("position")
        if checkpoint.get("splat") != splat:
            raise ValueError(
                f"The splat {self.scene.source} is not the one that the run in {output} began with, its content has "
                "changed: put that file back, or start again without --resume."
            )
        if isinstance(held, Tensor) and held.ndim == 2 and len(held) != self.scene.points.count:
            raise ValueError(
                f"The checkpoint in {output} holds {len(held)} particles, but the scene has "
                f"{self.scene.points.count}: resume with the same splat, or start again without --resume."
            )
        try:
            check_state(checkpoint, start, self.frame_dt, self.solver.max_nodes, bool(self.editor.edits))
        except (ValueError, TypeError, KeyError, RuntimeError) as error:
            raise unreadable(output / "checkpoint.pt", error) from error
        if checkpoint["frame"] >= frames:
            raise ValueError(
                f"The run in {output} has {checkpoint['frame'] + 1} frames already, and `frames` asks for {frames}: "
                "ask for more, or leave out --resume."
            )

    def _run(
        self,
        recorder: Recorder,
        frames: int,
        config: str,
        settings: dict[str, Any] | None,
        progress: bool,
        state: MPMState,
        checkpoint: dict[str, Any] | None,
        splat: str | None,
    ) -> dict[str, Any]:
        first, log, walls, peak = 0, [], _Walls(self.device), _PeakMemory(self.device)
        if checkpoint is not None:
            state = self._edit_due(MPMState.from_state_dict(checkpoint["state"], self.device), resumed=True)
            first, log = checkpoint["frame"] + 1, checkpoint["log"]
            walls.seconds.update(checkpoint["wall_s"])
        status, reason, done = "complete", None, first
        bar = self._progress = RunProgress(frames, first, progress)
        try:
            if self.device.type == "cuda" and first < frames:
                with walls("startup"):
                    self._warm_up(recorder, state, first)
            for frame in range(first, frames):
                bar.begin(frame)
                with walls("simulation"):
                    if frame > 0:
                        state, health = self.advance(state)
                        state = self._edit_due(state)
                    else:
                        health = diagnose(self.solver, state, 0, 0.0)
                self._record(recorder, state, frame, walls)
                log.append(health.as_dict())
                with walls("writing"):
                    if recorder.checkpoint_every and (frame + 1) % recorder.checkpoint_every == 0:
                        recorder.write_checkpoint(
                            {
                                "frame": frame,
                                "state": state.state_dict(),
                                "log": log,
                                "config": config,
                                "wall_s": walls.read(),
                                "splat": splat,
                            }
                        )
                done = frame + 1
                bar.end(health.substeps, health.displacement_mean)
            with walls("writing"):
                recorder.wait()
        except SimulationDiverged as error:
            status, reason = "diverged", str(error)
            raise
        except KeyboardInterrupt as stop:
            status, reason = "interrupted", signals.reason(stop)
            raise
        except Exception as error:
            status, reason = "failed", str(error)
            raise
        finally:
            with suppress(OSError):  # a terminal that has gone
                bar.close()
                if progress:
                    for sentence in self.health(log[:done])[1]:
                        print(f"warning: {sentence}", file=sys.stderr)
            self._progress = None
            summary: dict[str, Any] = {"status": status, "reason": reason}
            summary |= self._summary(state, log[:done], frames, walls, peak) | (settings or {})
            if recorder.images and "force" in recorder.renders:
                summary["force_scale_Pa"] = recorder.force_scale or self._force_end
            # the video of a run that was stopped early is made too: nothing that was recorded is lost
            self.files = []
            try:
                with walls("writing"):
                    self.files = recorder.close(done, summary, release=False)
            except OSError as error:
                if status == "complete":
                    raise
                print(f"{error}", file=sys.stderr)  # what stopped the run matters more
        summary["wall_s"] = walls.read(wait=True)
        recorder.write_summary(summary)
        return summary

    def health(self, log: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """What moved and was stretched most in a run, and sentences on what to change; none if all is well.

        Args:
            log: Diagnostics of its frames.
        """
        scene, points = self.scene, self.scene.points
        where = scene.frame.point_to_scene(points.position.double().cpu())
        elastic = self.solver.laws.elastic_particles()
        size = scene.size * scene.frame.metres_per_unit
        found = extremes(log, where, size, None if elastic is None else elastic.cpu())
        return found, advice(found, float(points.youngs_modulus.amax()), scene.filled == 0)

    def _warm_up(self, recorder: Recorder, state: MPMState, frame: int) -> None:
        """Load and compile the kernels of a frame, of which nothing is kept."""
        with suppress(SimulationDiverged):  # the frame itself will say so
            state, _ = self.advance(state)
        if recorder.images:
            gaussians = self.scene.deformed(state, rotations=self.scene.model.view_dependent)
            camera = self.camera_at(frame)
            self.draw(gaussians, self.colors(gaussians, camera), camera)

    def _record(self, recorder: Recorder, state: MPMState, frame: int, walls: _Walls) -> None:
        exporting = recorder.ply_every > 0 and frame % recorder.ply_every == 0
        if recorder.images or exporting:
            with walls("shading"):
                gaussians = self.scene.deformed(state, rotations=self.scene.model.view_dependent)
        if recorder.images:
            for name in ("", *self.cameras):
                self._picture(recorder, state, gaussians, frame, name, walls)
        with walls("writing"):
            if exporting:
                recorder.write_splat(frame, self.cloud(gaussians), self.scene.frame)
            if recorder.trajectory:
                recorder.write_trajectory(frame, state.position, state.F_total)

    def _picture(
        self, recorder: Recorder, state: MPMState, gaussians: DeformedGaussians, frame: int, name: str, walls: _Walls
    ) -> None:
        """Draw and hand over what is wanted of a frame from one camera."""
        with walls("shading"):
            camera = self.camera_at(frame, name)
            colours = self.colors(gaussians, camera)
        images: dict[str, Tensor] = {}
        with walls("rendering"):
            if {"color", "depth"} & set(recorder.renders):
                picture = self.draw(gaussians, colours, camera)
                images["color"] = picture.color
            if "depth" in recorder.renders:
                depth, (near, far) = passes.mean_depth(picture), self._depth_range(frame, name)
                images["depth"] = passes.depth_colors(depth, near, far)
                steps = passes.depth_steps(depth, recorder.depth_step / self.scene.frame.metres_per_unit)
            if "normal" in recorder.renders:
                images["normal"] = self.draw_normals(gaussians, camera, recorder.normal_axes)
            if "force" in recorder.renders:
                images["force"] = self.draw_force(state, gaussians, camera, recorder.force_scale or self._force_end)
        with walls("writing"):
            for render in recorder.renders:
                recorder.write_image(frame, images[render], frame_folder(render, name))
            if "depth" in recorder.renders:
                recorder.write_depth(frame, steps, frame_folder("depth", name))

    def _depth_range(self, frame: int, name: str) -> tuple[float, float]:
        """Ends of the depth's colours [scene units]: the object's longest side before its centre, and behind it."""
        distance = float((self._camera(frame, name).position.to(self.scene.center) - self.scene.center).norm())
        return distance - self.scene.size, distance + self.scene.size

    def _summary(
        self, state: MPMState, log: list[dict[str, float]], frames: int, walls: _Walls, peak: _PeakMemory
    ) -> dict[str, Any]:
        moved = [entry["displacement_mean"] for entry in log]
        found, sentences = self.health(log)
        energy = [{k: entry[k] for k in ("kinetic", "elastic", "potential")} for entry in log]
        return {
            "device": describe_device(self.device),
            "versions": versions(),
            "seed": self.wind.seed,
            "particles": self.solver.points.count,
            "gaussians": len(self.scene.model.means),
            "simulated_gaussians": len(self.scene.chosen),
            "loose_gaussians": self.scene.loose,
            "surface_particles": self.scene.on_surface,
            "filled_particles": self.scene.filled,
            "mass_kg": float(self.solver.points.mass.sum()),
            "patch_area_m2": float(self.scene.patch_area.sum()),
            "formulation": self.solver.formulation,
            "dtype": str(state.position.dtype).removeprefix("torch."),
            "grid": {"dx_m": self.solver.dx, "resolution": list(state.grid.resolution)},
            "frame": self.scene.frame.describe(),
            "sim_frame": {
                "origin": self.scene.frame.origin.tolist(),
                "rotation": self.scene.frame.rotation.tolist(),
                "metres_per_unit": self.scene.frame.metres_per_unit,
            },
            "size_m": self.scene.size * self.scene.frame.metres_per_unit,
            "frames": len(log),
            "frames_wanted": frames,
            "frame_dt_s": self.frame_dt,
            "edits": self.editor.applied,
            "substeps": int(sum(entry["substeps"] for entry in log)),
            "simulated_s": float(state.time),
            "wall_s": walls.read(wait=True),
            "peak_memory_bytes": peak.read(),
            "energy_start_J": energy[0] if energy else None,
            "energy_end_J": energy[-1] if energy else None,
            "largest_cfl": max((entry["cfl"] for entry in log), default=None),
            "wind_work_J": sum(entry.get("wind_work", 0.0) for entry in log),
            "lost_particles": int(log[-1]["lost"]) if log else 0,
            "torn_particles": int(log[-1].get("torn", 0)) if log else 0,
            "stretch_min": min((entry["stretch_min"] for entry in log), default=None),
            "stretch_max": max((entry["stretch_max"] for entry in log), default=None),
            "displacement_mean_max_m": max(moved, default=None),
            "extremes": found,
            "warnings": sentences,
            "per_frame": log,
        }


class _Walls:
    """Seconds spent in each part of the run.

    Startup: on a GPU, a first frame that is thrown away, with which kernels are loaded and compiled. Simulation,
    shading and rendering: from their begin to their end, on a GPU as its stream gets to them, so that the host need not
    wait there. Writing: how long the main thread was kept by the recorder, not what its threads did meanwhile.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = {"simulation": 0.0, "shading": 0.0, "rendering": 0.0, "writing": 0.0}
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        if self.device.type == "cuda" and part != "writing":
            stream = torch.cuda.current_stream(self.device)
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            start.record(stream)
            try:
                yield
            finally:
                end.record(stream)
                self._events.append((part, start, end))
            return
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] += time.perf_counter() - begin

    def read(self, wait: bool = False) -> dict[str, float]:
        """The seconds of each part [s], without what a GPU has still to do unless asked to wait for it."""
        if wait and self._events:
            self._events[-1][2].synchronize()
        while self._events and self._events[0][2].query():
            part, start, end = self._events.pop(0)
            self.seconds[part] = self.seconds.get(part, 0.0) + start.elapsed_time(end) / 1000
        return dict(self.seconds)


class _PeakMemory:
    """Largest memory of the process and, on a GPU, of torch's allocator."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def read(self) -> dict[str, int | None]:
        try:
            import resource
        except ImportError:  # Windows
            host = None
        else:
            unit = 1 if sys.platform == "darwin" else 1024
            host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
        device = torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else None
        return {"host": host, "device": device}


def describe_device(device: torch.device) -> str:
    """Name of the processor or GPU, with the number of threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()} CPU, {torch.get_num_threads()} threads"


def versions() -> dict[str, str]:
    """Versions that a number depends on."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "gaussian_swaying": gaussian_swaying.__version__}
    for name in ("torch", "gsplat", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


__all__ = ["SimulationPipeline", "describe_device", "versions"]
