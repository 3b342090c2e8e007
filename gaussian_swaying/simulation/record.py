"""A whole run: simulate, draw and record, from rest or from a checkpoint."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._files import sha256
from gaussian_swaying._provenance import describe_device, peak_memory, versions
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.checkpoint import log_lines
from gaussian_swaying.recording.recorder import Recorder, frame_folder
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.runs import signals
from gaussian_swaying.simulation.body import SimulatedScene, coarse, narrow
from gaussian_swaying.simulation.certificate import Certificate
from gaussian_swaying.simulation.draw import Painter, View, frames_from
from gaussian_swaying.simulation.measure import RunProgress, SimulationDiverged, advice, extremes
from gaussian_swaying.simulation.step import SceneEditor, Stepper, check_recorder

MAX_LOOKS = 2_000  # largest number of frames whose cameras are checked before a run


def splat_checksum(scene: SimulatedScene) -> str | None:
    """Checksum of the splat's file, to distinguish it from another file with the same name."""
    return None if scene.source is None else sha256(Path(scene.source))


def parts_checksum(scene: SimulatedScene) -> str | None:
    """Checksum of the parts of a scene, as their file may change."""
    return None if scene.parts is None else scene.parts.digest()


def _check_checkpoint(
    scene: SimulatedScene, checkpoint: dict[str, Any], output: Path, frames: int, splat: str | None
) -> None:
    """Raise ValueError unless the run can continue from a checkpoint as if it had never stopped."""
    held = checkpoint["state"].get("position")
    if checkpoint["splat"] != splat:
        raise ValueError(
            f"The splat {scene.source} has changed since the run in {output} began: restore the old file, or "
            "start again without --resume."
        )
    if checkpoint["parts"] != parts_checksum(scene):
        raise ValueError(
            f"The parts of the scene (`scene.parts`) have changed since the run in {output} began: restore the old "
            "file, or start again without --resume."
        )
    if held is not None and held.ndim == 2 and len(held) != scene.points.count:
        raise ValueError(
            f"The checkpoint in {output} holds {len(held)} particles, but the scene has "
            f"{scene.points.count}: resume with the same splat, or start again without --resume."
        )
    if checkpoint["frame"] >= frames:
        raise ValueError(
            f"The run in {output} has {checkpoint['frame'] + 1} frames already, but `frames` is {frames}: raise "
            "`frames`, or leave out --resume."
        )


def run_health(stepper: Stepper, log: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
    """Find what moved and stretched most in a run, with sentences on what to change; none if all is well."""
    scene, points = stepper.scene, stepper.model.points
    where = scene.frame.point_to_scene(points.position.cpu().double())
    elastic = points.elastic
    size = scene.size * scene.frame.metres_per_unit
    found = extremes(log, where, size, None if elastic is None else elastic.cpu())
    told = advice(found, float(points.youngs_modulus.amax()), scene.filled == 0, len(stepper.solver.boundaries) > 0)
    told += coarse(size, stepper.solver.dx)
    if scene.filled == 0 and found["moved"] is not None:
        told += narrow(points.position.reshape(-1, 3).cpu(), stepper.solver.dx, found["moved"]["share"])
    return found, told


class WallClock:
    """Seconds spent in each part of the run.

    Startup: on a GPU, a first frame that is thrown away, which loads and compiles the kernels. Simulation, shading and
        rendering: from start to end; on a GPU this is measured on its stream, so that the host need not wait, and as
        a frame is drawn while the next one is simulated, the parts may add up to more than the whole. Writing: the time
        that the main thread spends in the recorder, not the time of the recorder's own threads.
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
        """The time of each part [s]; with ``wait`` also that of GPU work that is not finished yet."""
        if wait and self._events:
            self._events[-1][2].synchronize()
        while self._events and self._events[0][2].query():
            part, start, end = self._events.pop(0)
            self.seconds[part] = self.seconds.get(part, 0.0) + start.elapsed_time(end) / 1000
        return dict(self.seconds)


NODAL = "node_displacement"


class Closing:
    """Makes a recorded motion loop, see ``recorder.loop``.

    Args:
        scene: The scene.
        recorder: The outputs.
        frames: Number of frames of the run.
        frame_dt: Time from one to the next [s].

    Attributes:
        count: Number of frames at the beginning that are not recorded by themselves.
    """

    def __init__(self, scene: SimulatedScene, recorder: Recorder, frames: int, frame_dt: float) -> None:
        self.scene, self.frames, self.count = scene, frames, round(recorder.loop / frame_dt)
        self._first: list[dict[str, Tensor]] = []
        if self.count and frames <= 2 * self.count:
            raise ValueError(
                f"`recorder.loop` of {recorder.loop:g} s is {self.count} frames, and the run has {frames}: raise "
                f"`frames` to more than {2 * self.count}, or shorten `recorder.loop`."
            )
        others = [render for render in recorder.renders if not PASSES[render].alone]
        if self.count and others:
            raise ValueError(f"With `recorder.loop`, `recorder.renders` cannot have {', '.join(others)}: leave it out.")

    def __call__(self, state: State, frame: int) -> State:
        late = frame - (self.frames - self.count)
        if frame < self.count:
            self._first.append({name: part.clone() for name, part in self._motion(state).items()})
        if not self.count or late < 0:
            return state
        share = (late + 1) / (self.count + 1)
        share *= share * (3 - 2 * share)
        motion = {name: part.lerp(self._first[late][name], share) for name, part in self._motion(state).items()}
        nodes = self.scene.follow.nodes(state)
        if nodes is not None:
            rest: Any = state
            motion[NODAL] = rest.node_displacement.index_copy(0, nodes, motion[NODAL])
        return state.replace(**motion)

    def _motion(self, state: State) -> dict[str, Tensor]:
        follow = self.scene.follow
        motion, nodal = {name: getattr(state, name) for name in follow.reads}, follow.nodal(state)
        return motion if nodal is None else motion | {NODAL: nodal}

    def kept(self) -> dict[str, Any]:
        return {"frames": self.frames if self.count else None, "count": self.count, "first": list(self._first)}

    def resume(self, kept: dict[str, Any]) -> None:
        """Restore what :meth:`kept` returned."""
        if (kept["frames"], kept["count"]) != (self.kept()["frames"], self.count):
            raise ValueError(
                "A motion that closes has a length: resume with the `frames` and the `recorder.loop` of the run, or "
                "start again without --resume."
            )
        device = self.scene.model.means.device
        self._first = [{name: part.to(device) for name, part in frame.items()} for frame in kept["first"]]


class Run:
    """A run: simulate, draw and record.

    Args:
        painter: Draws the scene.
        editor: Changes the scene, and has its stepper.
        recorder: The outputs.
        frames: Number of frames; the first is the state at rest.
        config: The resume key.
        certificate: Tells how far the motion can be trusted; None if that is not asked.

    Attributes:
        log: Diagnostics of the frames.
    """

    def __init__(
        self,
        painter: Painter,
        editor: SceneEditor,
        recorder: Recorder,
        frames: int,
        config: str = "",
        certificate: Certificate | None = None,
    ) -> None:
        self.painter, self.editor, self.recorder, self.frames, self.config = painter, editor, recorder, frames, config
        self.certificate = certificate
        self.stepper, self.scene = editor.stepper, painter.scene
        if self.stepper.copies is not None:
            check_recorder(recorder)
        for render in recorder.renders:
            if PASSES[render].air and self.stepper.model.air is None:
                raise ValueError(
                    f"`recorder.renders` has `{render}`, which only computed air has: add `air`, or remove it."
                )
        self.files: list[Path] = []
        self.log: list[dict[str, Any]] = []
        self._lines: list[str] = []  # the log as a checkpoint stores it, which is written every frame
        self.walls = WallClock(painter.device)
        if painter.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(painter.device)
        self.closing = Closing(self.scene, recorder, frames, self.stepper.frame_dt)
        self.splat = splat_checksum(self.scene)
        self.force_end = self.stepper.force_scale()

    @torch.inference_mode()
    def whole(self, output: Path, resume: bool, settings: dict[str, Any], progress: bool) -> dict[str, Any]:
        """Run from rest, or from a checkpoint, to the end; see ``Simulation.run``."""
        frames, recorder, painter = self.frames, self.recorder, self.painter
        for look in range(min(frames, MAX_LOOKS)):  # all of them, unless there are very many
            painter.check_camera(look * (frames - 1) // max(min(frames, MAX_LOOKS) - 1, 1))
        state = self.editor.start()  # errors are raised before anything is written

        def check(checkpoint: dict[str, Any]) -> None:
            _check_checkpoint(self.editor.scene, checkpoint, output, frames, self.splat)

        fps, cameras = 1 / self.stepper.frame_dt, tuple(painter.cameras)
        checkpoint = recorder.open(output, self.config, resume, fps, cameras, check)
        try:
            return self.go(state, checkpoint, settings, progress)
        finally:
            recorder.release()

    def go(
        self, state: State, checkpoint: dict[str, Any] | None, settings: dict[str, Any], progress: bool
    ) -> dict[str, Any]:
        """Run from a state at rest, or from a checkpoint, to the end; returns the summary."""
        stepper, recorder, walls = self.stepper, self.recorder, self.walls
        first = 0
        if checkpoint is not None:
            restored = type(state).from_state_dict(checkpoint["state"], stepper.device)
            state = self.editor.edit_due(restored, resumed=True)
            self.closing.resume(checkpoint["closing"])
            first, self.log = checkpoint["frame"] + 1, checkpoint["log"]
            walls.seconds.update(checkpoint["wall_s"])
        status, reason, done = "complete", None, first
        bar = stepper.progress = RunProgress(self.frames, first, progress)
        try:
            if stepper.device.type == "cuda" and first < self.frames:
                with walls("startup"):
                    self.warm_up(state, first)
            drawn = self.drawing_stream()
            frames = frames_from(self.painter, self.editor, state, first, self.frames, drawn)
            for index in range(first, self.frames):
                with walls("simulation"):
                    frame = next(frames)
                state = frame.state
                with torch.cuda.stream(drawn) if drawn is not None else nullcontext():
                    self.record(state, index)
                    if self.certificate is not None:
                        self.certificate.see(state)
                    self.log.append(frame.health.as_dict())
                    with walls("writing"):
                        self.keep(state, index)
                done = index + 1
                bar.end(frame.health.substeps, frame.health.displacement_mean)
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
            with suppress(OSError):  # the terminal may be closed
                bar.close()
                if progress:
                    for sentence in run_health(stepper, self.log[:done])[1] + recorder.told():
                        print(f"warning: {sentence}", file=sys.stderr)
            stepper.progress = None
            summary = self.close(status, reason, state, done, settings)
        summary["wall_s"] = walls.read(wait=True)
        if self.certificate is not None:
            summary["certificate"] = self.certificate.whole(self.log, sum(summary["wall_s"].values()), progress)
            self.files += self.certificate.plot(recorder.folder, summary["certificate"])
        recorder.write_summary(summary)
        return summary

    def close(
        self, status: str, reason: str | None, state: State, done: int, settings: dict[str, Any]
    ) -> dict[str, Any]:
        """Write everything that is left.

        Args:
            status: ``complete``, or how the run ended.
        """
        recorder = self.recorder
        summary: dict[str, Any] = {"status": status, "reason": reason}
        summary |= self.summary(state, self.log[:done]) | settings
        if recorder.images and "force" in recorder.renders:
            summary["force_scale_Pa"] = self.force_end
        # a run that was stopped early gets its video too, so that nothing recorded is lost
        self.files = []
        try:
            with self.walls("writing"):
                self.files = recorder.close(max(done - self.closing.count, 0), summary, release=False)
        except OSError as error:
            if status == "complete":
                raise
            print(f"{error}", file=sys.stderr)  # the error that stopped the run matters more
        return summary

    def warm_up(self, state: State, frame: int) -> None:
        with suppress(SimulationDiverged):  # the real frame will report it
            state, _ = self.stepper.advance(state)
        if self.recorder.images:
            self.painter.render(state, frame)

    def drawing_stream(self) -> torch.cuda.Stream | None:
        """A stream for pictures and files, so that the next frame is simulated at the same time; None on a CPU.

        Also None if the host calls a force of the user in every substep.
        """
        stepper = self.stepper
        forces = all(force.recordable for force in stepper.forces)
        if stepper.device.type != "cuda" or not stepper.solver.has_kernels or not forces:
            return None
        return torch.cuda.Stream(stepper.device)

    def keep(self, state: State, frame: int) -> None:
        if self.recorder.checkpoint_every and (frame + 1) % self.recorder.checkpoint_every == 0:
            self.recorder.write_checkpoint(
                {
                    "frame": frame,
                    "state": state.state_dict(),
                    "log": log_lines(self.log, self._lines),
                    "config": self.config,
                    "wall_s": self.walls.read(),
                    "recorded": max(frame + 1 - self.closing.count, 0),
                    "closing": self.closing.kept(),
                    "splat": self.splat,
                    "parts": parts_checksum(self.scene),
                    "nodes": self.scene.follow.nodes(state) is not None,
                }
            )

    @property
    def recording(self) -> bool:
        recorder = self.recorder
        return recorder.images or recorder.trajectory or recorder.nodes

    def record(self, state: State, frame: int) -> None:
        recorder, walls = self.recorder, self.walls
        state, frame = self.closing(state, frame), frame - self.closing.count
        if frame < 0:
            return
        if recorder.images:
            with walls("shading"):
                gaussians = self.painter.deformed(state)
            for name in ("", *self.painter.cameras):
                self.picture(state, gaussians, frame, name)
        with walls("writing"):
            if recorder.trajectory:
                recorder.write_trajectory(frame, *self.scene.surface(state))
            moved = self.scene.follow.nodal(state) if recorder.nodes else None
            if moved is not None:
                limit = self.scene.size * self.scene.frame.metres_per_unit / 2  # rounding to float16 is 0.02 % of it
                recorder.write_nodes(frame, moved, limit)

    def picture(self, state: State, gaussians: DeformedGaussians, frame: int, name: str) -> None:
        """Draw the requested pictures of a frame from one camera and pass them to the recorder."""
        painter, walls = self.painter, self.walls
        with walls("shading"):
            camera = painter.camera_at(frame, name)
            colours = painter.colors(gaussians, camera)
        view = View(painter, state, gaussians, camera, colours, force_end=self.force_end)
        with walls("rendering"):
            made = [(render, PASSES[render].draw(view)) for render in self.recorder.renders]
            raws = [(render, raw(view)) for render, _ in made if (raw := PASSES[render].raw)]
        with walls("writing"):
            for render, image in made:
                self.recorder.write_image(frame, image, frame_folder(render, name))
            for render, numbers in raws:
                self.recorder.write_raw(frame, numbers, frame_folder(render, name))

    def summary(self, state: State, log: list[dict[str, Any]]) -> dict[str, Any]:
        stepper, scene, points = self.stepper, self.scene, self.stepper.model.points
        moved = [entry["displacement_mean"] for entry in log]
        found, sentences = run_health(stepper, log)
        energy = [{k: entry[k] for k in ("kinetic", "elastic", "potential")} for entry in log]
        return {
            "device": describe_device(stepper.device),
            "versions": versions(),
            "seed": getattr(stepper.model.wind, "seed", None),
            "splat_sha256": self.splat,
            "particles": points.count,
            "copies": 1 if stepper.copies is None else len(stepper.copies),
            "gaussians": len(scene.model.means),
            "simulated_gaussians": len(scene.simulated),
            "loose_gaussians": scene.loose,
            "surface_particles": scene.on_surface,
            "recorded_surface": scene.on_surface if scene.track is None else scene.tracked,
            "filled_particles": scene.filled,
            "mass_kg": float(points.mass.sum()),
            "patch_area_m2": float(scene.patches.area.sum()),
            "hull_area_m2": scene.hull_area(),
            "computed_air": None if stepper.air is None else asdict(stepper.air.resolution),
            **stepper.solver.describe(state),
            "dtype": str(state.position.dtype).removeprefix("torch."),
            "frame": scene.frame.describe(),
            "sim_frame": {
                "origin": scene.frame.origin.tolist(),
                "rotation": scene.frame.rotation.tolist(),
                "metres_per_unit": scene.frame.metres_per_unit,
            },
            "file_origin": scene.model.origin,
            "size_m": scene.size * scene.frame.metres_per_unit,
            "frames": len(log),
            "frames_wanted": self.frames,
            "frame_dt_s": stepper.frame_dt,
            "edits": self.editor.applied,
            "substeps": int(sum(entry["substeps"] for entry in log)),
            "simulated_s": float(state.time),
            "wall_s": self.walls.read(wait=True),
            "peak_memory_bytes": peak_memory(stepper.device),
            "energy_start_J": energy[0] if energy else None,
            "energy_end_J": energy[-1] if energy else None,
            "largest_cfl": max((entry["cfl"] for entry in log), default=None),
            "wind_work_J": sum(entry["wind_work"] for entry in log),
            "lost_particles": int(log[-1]["lost"]) if log else 0,
            "torn_particles": int(log[-1]["torn"]) if log else 0,
            "stretch_min": min((entry["stretch_min"] for entry in log), default=None),
            "stretch_max": max((entry["stretch_max"] for entry in log), default=None),
            "displacement_mean_max_m": max(moved, default=None),
            "extremes": found,
            "warnings": sentences + self.recorder.told(),
            "per_frame": log,
        }
