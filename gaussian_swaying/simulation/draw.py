"""Pictures of a simulated scene: cameras, colours, copies, streaks of air, and frames."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._devices import in_double
from gaussian_swaying._files import atomic, is_blank, save_png
from gaussian_swaying._fixed import Fixed, fixed
from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.gaussians.formats import export_cloud
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.gaussians.ply import check_folder
from gaussian_swaying.kernels.graphs import RECORDED, Replayed, recorded_key
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.layout import check_camera_name
from gaussian_swaying.rendering import passes
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.rendering.cameras.camera_path import CameraPath, OrbitCamera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.passes import colormap, mean_depth
from gaussian_swaying.rendering.protocol import Renderer, RenderOutput
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.measure import FrameDiagnostics
from gaussian_swaying.simulation.model import Model
from gaussian_swaying.simulation.step import Launched, SceneEditor, Stepper, stepper_of
from gaussian_swaying.wind.field import WindField

MAX_PIXELS = 1 << 26  # per picture: twice as many as 8K


class Painter(Fixed, nn.Module):
    """Draws a simulated scene from its cameras.

    Args:
        stepper: Has the Gaussians, and how they follow the material.
        shader: Colours from normals and light; None keeps the colours of the splat.
        camera: Camera path; an orbit camera if None.
        cameras: Further cameras by name.
        background: Background colour, in [0, 1].
        renderer: Draws the Gaussians; by default gsplat on CUDA and the torch renderer elsewhere, chosen at the first
            picture.

    Raises:
        ValueError: If the background or the name of a camera is invalid.
    """

    assignable = ("shader", "camera", "cameras", "background")
    background: Tensor

    def __init__(
        self,
        stepper: Stepper,
        shader: Shader | None = None,
        camera: CameraPath | None = None,
        cameras: Mapping[str, CameraPath] | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__()
        if not all(0 <= value <= 1 for value in background):
            raise ValueError(f"Expected `background` within [0, 1], but got {list(background)}: 1 is white, not 255.")
        self.stepper, self.shader = stepper, shader
        origin = self.scene.model.origin
        self.camera = (camera or OrbitCamera()).counted_from(origin)
        self.cameras = {name: path.counted_from(origin) for name, path in (cameras or {}).items()}
        for name in self.cameras:
            check_camera_name(name)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32))
        self._renderer = renderer
        self._moved, self._coloured = Replayed(), Replayed()
        self._rest: tuple[Camera, object, Tensor, Tensor] | None = None  # of many Gaussians that do not move
        self._still: dict[str, tuple[tuple[object, ...], Camera]] = {}  # cameras of the last frame that do not move

    @property
    def scene(self) -> SimulatedScene:
        """The Gaussians, and how they follow the material."""
        return self.stepper.scene

    @property
    def turn(self) -> Turn:
        """The lock of the thread that steps or draws the simulation."""
        return self.stepper.turn

    @property
    def device(self) -> torch.device:
        return self.background.device

    @property
    def center(self) -> Tensor:
        """Centre of what moves at rest, at which cameras look [scene units], shape (3,)."""
        return self.scene.center

    @property
    def size(self) -> float:
        """Longest side of what moves at rest [scene units]."""
        return self.scene.size

    @property
    def renderer(self) -> Renderer:
        if self._renderer is None:
            self._renderer = make_renderer(self.device)
        return self._renderer

    @renderer.setter
    def renderer(self, renderer: Renderer) -> None:
        self._renderer = renderer

    @in_turn
    def camera_at(self, frame: int, name: str = "") -> Camera:
        """The camera of a frame, on the device and in the precision of the Gaussians; one copy, without waiting for it.

        Args:
            name: Which of ``cameras``; empty for ``camera``.
        """
        means, path = self.scene.model.means, self.cameras[name] if name else self.camera
        if not path.still:
            return self._camera(frame, name).to(means.device, means.dtype)
        key = (path, means.device, means.dtype)
        if self._still.get(name, ((), None))[0] != key:
            with torch.inference_mode(False):  # it outlives the call
                self._still[name] = (key, self._camera(frame, name).to(means.device, means.dtype))
        return self._still[name][1]

    def _camera(self, frame: int, name: str = "") -> Camera:
        """The camera of a frame, in float64 on the host."""
        path = self.cameras[name] if name else self.camera
        return path(frame, frame * self.stepper.frame_dt, self.center, self.scene.frame.rotation[2], self.size)

    def check_camera(self, frame: int) -> None:
        """Raise ValueError if a camera of a frame lies inside the box of the object at rest, or has too many pixels.

        Cameras of a capture may lie inside the box, as their places are given: around an object or in a room.
        """
        low, high = self.scene.bounds
        for name, path in {"": self.camera, **self.cameras}.items():
            camera, field = self._camera(frame, name), f"cameras.{name}" if name else "camera"
            if camera.width * camera.height > MAX_PIXELS:
                raise ValueError(
                    f"A picture of {camera.width:,} x {camera.height:,} pixels is too large (the limit is "
                    f"{MAX_PIXELS:,}): lower `{field}.init_args.width` and `height`."
                )
            if path.captured:
                continue
            eye = camera.position.to(low)
            if self._hits(eye):
                raise ValueError(
                    f"The camera at {[round(v, 3) for v in eye.tolist()]} lies inside the object, whose box reaches "
                    f"from {[round(v, 3) for v in low.tolist()]} to {[round(v, 3) for v in high.tolist()]} (scene "
                    f"units): move it out with `{field}.init_args.radius` or `eye`."
                )

    def _hits(self, eye: Tensor) -> bool:
        """True if a point (3,) lies inside the box of the object at rest."""
        low, high = self.scene.bounds
        return bool(((eye > low) & (eye < high)).all())

    @in_turn
    def deformed(self, state: State) -> DeformedGaussians:
        """The Gaussians of a state, in scene units, with the rotations that their colours need."""
        scene, turned, follow = self.scene, self.scene.model.view_dependent, self.scene.follow
        if len(scene.model.means) > RECORDED:
            return scene.deformed(state, rotations=turned)

        def moved(*fields: Tensor) -> list[Tensor]:
            found = scene.deformed(state.replace(**dict(zip(follow.reads, fields, strict=True))), rotations=turned)
            return [found.means, found.covariances, found.normals, *([found.rotations] if turned else [])]

        given = [getattr(state, name) for name in follow.reads]
        found = self._moved((recorded_key([scene]), follow.layout(state)), moved, *given)
        parts: dict[str, Any] = dict(zip(("means", "covariances", "normals", "rotations"), found, strict=False))
        return replace(scene.rest(), **parts)

    @in_turn
    def colors(self, gaussians: DeformedGaussians, camera: Camera) -> Tensor:
        """Shaded colours, shape (N, 3): harmonics evaluated in the rest frame of each patch, times the shading.

        Of many Gaussians, those that do not move are computed once for a camera.
        """
        means, shader, scene = gaussians.means, self.shader, self.scene
        eye, index = camera.position.to(means), scene.moving
        if len(means) > RECORDED and not scene.all_move:
            still, harmonics = self._still_colours(camera, eye)
            turned = gaussians.rotations[index] if scene.model.view_dependent else None
            colours = seen_from(harmonics, eye, means[index], turned)
            return still.index_copy(0, index, self._shaded(colours, gaussians.normals[index]))
        given = [eye, means, gaussians.normals]
        given += [gaussians.rotations] if scene.model.view_dependent else []
        if len(means) > RECORDED or not (shader is None or shader.recordable):
            return self._colors(*given)
        key = recorded_key([scene, *([] if shader is None else [shader])])
        return self._coloured(key, lambda *known: [self._colors(*known)], *given)[0]

    def _colors(self, eye: Tensor, means: Tensor, normals: Tensor, rotations: Tensor | None = None) -> Tensor:
        scene, index = self.scene, self.scene.moving
        colours = seen_from(scene.model.sh, eye, means, rotations)
        if scene.all_move:
            return self._shaded(colours, normals)
        if self.shader is None:
            return colours
        return colours.index_copy(0, index, self._shaded(colours[index], normals[index]))

    def _shaded(self, colours: Tensor, normals: Tensor) -> Tensor:
        if self.shader is None:
            return colours
        scene = self.scene
        return self.shader(colours, scene.frame.direction_to_sim(normals), rest_normal=scene.rest_facing)

    def _still_colours(self, camera: Camera, eye: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (N, 3) of all Gaussians at rest, and the harmonics of those that move; kept for the last camera.

        They are not kept where gradients are wanted, or where a change in place cannot be seen.
        """
        model = self.scene.model
        parts = (model.means, model.sh0, model.shN, camera.world_to_camera)
        if any(part.is_inference() or (part.requires_grad and torch.is_grad_enabled()) for part in parts):
            return self._rest_colours(eye)
        key = (recorded_key([self.scene]), *(part._version for part in parts))
        if self._rest is None or self._rest[0] is not camera or self._rest[1] != key:
            with torch.inference_mode(False), torch.no_grad():  # they outlive the call
                self._rest = (camera, key, *self._rest_colours(eye.clone()))
        return self._rest[2:]

    def _rest_colours(self, eye: Tensor) -> tuple[Tensor, Tensor]:
        """The same for an eye (3,), computed anew."""
        model, index = self.scene.model, self.scene.moving
        way = torch.nn.functional.normalize(model.means.detach() - eye, dim=-1)
        still = torch.cat([
            sh_to_color(torch.cat([model.sh0[k : k + RECORDED], model.shN[k : k + RECORDED]], 1),
                        way[k : k + RECORDED])
            for k in range(0, len(way), RECORDED)
        ])  # fmt: skip
        return still, torch.cat([model.sh0[index], model.shN[index]], 1)

    def shade(self, gaussians: DeformedGaussians, camera: Camera) -> DeformedGaussians:
        """The Gaussians with colours as seen from a camera."""
        return replace(gaussians, colors=self.colors(gaussians, camera))

    @in_turn
    def draw(self, gaussians: DeformedGaussians, colours: Tensor, camera: Camera) -> RenderOutput:
        """Draw Gaussians in scene units."""
        return self.renderer(gaussians.means, gaussians.covariances, self.opacity(), colours, camera, self.background)

    @in_turn
    def render(self, state: State, frame: int, name: str = "") -> RenderOutput:
        """The picture of a state from the camera of a frame.

        Args:
            name: Which of ``cameras``; empty for ``camera``.
        """
        return self.picture(self.deformed(state), self.camera_at(frame, name))

    def picture(self, gaussians: DeformedGaussians, camera: Camera) -> RenderOutput:
        """The picture of Gaussians in scene units with their own colours, from a camera on their device."""
        return self.draw(gaussians, self.colors(gaussians, camera), camera)

    def opacity(self) -> Tensor:
        """Opacities of the Gaussians that are drawn, shape (N,)."""
        return self.scene.model.opacity()


def draw(
    model: Model, state: State, camera: Camera, shader: Shader | None = None, background: Sequence[float] = (0, 0, 0)
) -> RenderOutput:
    """The picture of a state of :func:`~gaussian_swaying.simulation.step.step`.

    Args:
        shader: Colours from normals and light; None keeps the colours of the splat.
        background: Background colour, in [0, 1].

    Returns:
        Colour, opacity and depth, shape (H, W, ·).
    """
    stepper, known = stepper_of(model), model.shared.get("painter")
    if known is None or known[0] is not shader or known[1] != tuple(background):
        painter = Painter(stepper, shader, background=background).to(stepper.device)
        known = model.shared["painter"] = (shader, tuple(background), painter)
    means = model.scene.model.means
    return known[2].picture(known[2].deformed(state), camera.to(means.device, means.dtype))


def seen_from(sh: Tensor, eye: Tensor, means: Tensor, rotations: Tensor | None) -> Tensor:
    """Colours as seen from an eye in each Gaussian's rest frame, shape (N, 3)."""
    view = torch.nn.functional.normalize(means - eye, dim=-1)
    at_rest = view if rotations is None else (view[..., None] * rotations).sum(-2)
    return sh_to_color(sh, at_rest)


class CopiesPainter(Painter):
    """Draws the static Gaussians once and the object once for each copy, all from one splat.

    With S static Gaussians, B copies, and M moving and H held ones in each. Only centres, shapes, normals and colours
    exist for each copy; harmonics and opacities are those of the splat.

    Args:
        stepper: Has copies.
        parts: The other arguments of a :class:`Painter`.
    """

    still: Tensor
    held: Tensor

    def __init__(self, stepper: Stepper, *parts: Any) -> None:
        super().__init__(stepper, *parts)
        assert stepper.copies is not None
        self.copies, scene = stepper.copies, stepper.scene
        copies = self.copies
        count = len(scene.model.means)
        moves, belongs = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        moves[scene.moving], belongs[scene.simulated], belongs[scene.carried] = True, True, True
        self.register_buffer("still", (~belongs).nonzero()[:, 0], persistent=False)
        self.register_buffer("held", (belongs & ~moves).nonzero()[:, 0], persistent=False)
        means = scene.model.means.detach()[scene.simulated]
        placed = torch.stack([copies.place(k, means) for k in range(len(copies))])
        extent = (placed.amax((0, 1)) - placed.amin((0, 1))).amax()
        alone = (means.amax(0) - means.amin(0)).amax()
        self._size = scene.size + float(extent - alone)
        own, all_of_them = (scene.frame.point_to_sim(in_double(part)) for part in (means, placed))
        middle, before = (0.5 * (part.amin(0) + part.amax(0)) for part in (all_of_them.flatten(0, 1), own))
        self._center = scene.center + scene.frame.displacement_to_scene(middle - before)

    @property
    def center(self) -> Tensor:
        """Centre of all copies at rest [scene units], shape (3,)."""
        return self._center

    @property
    def size(self) -> float:
        """Longest side of all copies at rest [scene units]."""
        return self._size

    def _hits(self, eye: Tensor) -> bool:
        return any(super(CopiesPainter, self)._hits(point) for point in self.copies.in_object(eye).to(eye))

    @in_turn
    def deformed(self, state: State) -> DeformedGaussians:
        """The static Gaussians and those of all copies in a state of shape (B, ...), in scene units."""
        scene, copies, turned = self.scene, self.copies, self.scene.model.view_dependent
        rest = scene.rest()
        kept = ("means", "covariances", "normals", *(["rotations"] if turned else []))
        parts = {name: [getattr(rest, name)[self.still]] for name in kept}
        held = {name: getattr(rest, name)[self.held] for name in kept}
        for number, A in enumerate(copies.rotation):
            moved, A = scene.moved(state.scene(number), rotations=turned), A.to(rest.means)
            own = {name: torch.cat([moved[name], held[name]]) for name in kept}
            parts["means"].append(copies.place(number, own["means"]))
            parts["covariances"].append(A @ own["covariances"] @ A.mT)
            parts["normals"].append(own["normals"] @ A.mT)
            if turned:
                parts["rotations"].append(A @ own["rotations"])
        found: dict[str, Any] = {name: torch.cat(tensors) for name, tensors in parts.items()}
        found.setdefault("rotations", scene.identity.expand(len(found["means"]), 3, 3))
        return DeformedGaussians(**found)

    @in_turn
    def colors(self, gaussians: DeformedGaussians, camera: Camera) -> Tensor:
        """As those of a :class:`Painter`, shape (S + B (M + H), 3); of what is static they are computed once."""
        model, eye = self.scene.model, camera.position.to(gaussians.means)
        still, moving = self._still_colours(camera, eye)
        held = torch.cat([model.sh0[self.held], model.shN[self.held]], 1)
        sizes = [len(self.still), *[len(moving), len(held)] * len(self.copies)]
        given = gaussians.means, gaussians.normals, gaussians.rotations
        _, *groups = zip(*(each.split(sizes) for each in given), strict=True)
        found = [still[self.still]]
        for number, (means, normals, rotations) in enumerate(groups):
            moves = number % 2 == 0
            turned = rotations if model.view_dependent else None
            colours = seen_from(moving if moves else held, eye, means, turned)
            found.append(self._shaded(colours, normals) if moves else colours)
        return torch.cat(found)

    def opacity(self) -> Tensor:
        """Opacities of the Gaussians that are drawn, shape (S + B (M + H),)."""
        opacity = self.scene.model.opacity()
        own = torch.cat([opacity[self.scene.moving], opacity[self.held]])
        return torch.cat([opacity[self.still], own.repeat(len(self.copies))])


ACROSS = 26
"""Streaks along the longer side of the picture."""

STEPS = 12
"""Straight pieces of a streak."""


def streaks(stepper: Stepper, state: State, camera: Camera) -> tuple[Tensor, Tensor]:
    """Streamline segments of the air at one moment, near a plane through the object.

    The plane contains the direction of the flow, and is upright or level, whichever the camera sees better. They start
    at the points of a lattice that drifts with the mean flow, so that they move from frame to frame as the air does,
    and are as long as the air flows in a fixed time: an eighth of the picture at the speed of the flow.

    Returns:
        Places, scene units, shape (S, STEPS + 1, 3), and the speed at them [m/s], shape (S, STEPS + 1).
    """
    frame, wind = stepper.scene.frame, stepper.model.wind
    device, double = state.position.device, torch.float64
    mean, centre, eye = _middle(stepper, state, camera)
    view = centre - eye
    distance = view.norm()
    carried = wind.carried(state.time) if isinstance(wind, WindField) else mean * state.time
    right, up = _plane(mean, view / distance)
    high = 1.15 * float(distance) * camera.height / float(camera.intrinsics[1, 1])
    wide = high * camera.width / camera.height
    gap = wide / ACROSS
    rows, columns = math.ceil(high / gap), ACROSS + 2
    axes = (torch.arange(count, dtype=double, device=device) for count in (rows, columns))
    j, i = torch.meshgrid(*axes, indexing="ij")
    jitter = torch.rand(2, rows, columns, generator=torch.Generator().manual_seed(0), dtype=double).to(device) - 0.5
    x = (i + 0.5 + 0.8 * jitter[0]) * gap + (carried * right).sum()
    y = (j + 0.5 + 0.8 * jitter[1]) * gap + (carried * up).sum()
    x, y = x.remainder(columns * gap) - 0.5 * columns * gap, y.remainder(rows * gap) - 0.5 * rows * gap
    place = (centre + x[..., None] * right + y[..., None] * up).reshape(-1, 3)
    speed = float(mean.norm())
    seconds = 0.125 * wide / max(speed, 1e-6) if speed > 0 else 1.0
    places, speeds = [], []
    for _ in range(STEPS + 1):
        air = stepper.air_at(state, place.to(state.position))
        air = in_double(air).expand_as(place)
        places.append(place)
        speeds.append(torch.linalg.vector_norm(air, dim=-1))
        half = place + 0.5 * seconds / STEPS * air  # midpoint rule
        middle = in_double(stepper.air_at(state, half.to(state.position))).expand_as(place)
        place = place + seconds / STEPS * middle
    points = torch.stack(places, 1)
    return frame.point_to_scene(points.reshape(-1, 3)).view_as(points), torch.stack(speeds, 1)


def _middle(stepper: Stepper, state: State, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Mean flow [m/s], centre of the object and eye [m], each of shape (3,)."""
    device, frame, wind = state.position.device, stepper.scene.frame, stepper.model.wind
    centre = frame.point_to_sim(stepper.scene.center.to(device).double()[None])[0]
    eye = frame.point_to_sim(camera.position.to(device).double()[None])[0]
    mean = wind.mean_flow(state.time) if isinstance(wind, WindField) else in_double(stepper.flows()).mean(0)
    return mean, centre, eye


def _plane(flow: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions of the plane in which air is drawn, from the flow [m/s] and the view, each of shape (3,)."""
    z = torch.tensor([0.0, 0.0, 1.0], device=flow.device, dtype=flow.dtype)
    x = torch.tensor([1.0, 0.0, 0.0], device=flow.device, dtype=flow.dtype)
    along = flow / flow.norm() if float(flow.norm()) > 0 else x
    level = torch.linalg.cross(z if float(along[2].abs()) < 0.9 else x, along)
    level = level / level.norm()
    upright = torch.linalg.cross(along, level)
    if max(float((side * ahead).sum().abs()) for side in (level, upright)) < 0.35:  # along the view: a plane across it
        level = torch.linalg.cross(z, ahead)
        return level / level.norm(), torch.linalg.cross(ahead, level / level.norm())
    return (
        (along, upright)
        if float((level * ahead).sum().abs()) > float((upright * ahead).sum().abs())
        else (along, level)
    )


def speed_scale(stepper: Stepper) -> float:
    """End of the colour scale of streaks [m/s]: 1.5 times the mean flow; 0 in still air."""
    return 1.5 * float(torch.linalg.vector_norm(stepper.flows(), dim=-1).amax())


@dataclass(frozen=True, eq=False)
class View:
    """The scene at one moment from one camera: the input of a pass.

    Args:
        painter: Draws the scene; it has the stepper.
        state: The state.
        gaussians: Its Gaussians, in scene units.
        camera: The camera, on their device.
        colors: Their colours from there, shape (N, 3); those of the painter if None.
        live: Whether it is for the live page: edges fade to black instead of ending at a pixel, and normals are in
            world axes (z up) instead of those of the camera (x right, y up, z towards it).
        force_end: End of the colour scale of forces [Pa].
    """

    painter: Painter
    state: State
    gaussians: DeformedGaussians
    camera: Camera
    colors: Tensor | None = None
    live: bool = False
    force_end: float = 1.0

    @cached_property
    def picture(self) -> RenderOutput:
        """The picture in colour."""
        colors = self.painter.colors(self.gaussians, self.camera) if self.colors is None else self.colors
        return self.painter.draw(self.gaussians, colors, self.camera)

    @property
    def depth_range(self) -> tuple[Tensor, Tensor]:
        """Ends of the depth's colour scale [scene units]: one longest side before and behind the object's centre."""
        eye, size = self.camera.position, self.painter.size
        distance = torch.linalg.vector_norm(eye - self.painter.center.to(eye, non_blocking=True))  # no wait for a GPU
        return distance - size, distance + size

    def blend(self, values: Tensor) -> RenderOutput:
        """Blend three values per Gaussian, shape (N, 3), like colours, over zero."""
        painter, own = self.painter, self.gaussians
        return painter.renderer(own.means, own.covariances, painter.opacity(), values, self.camera)

    def scalar(self, values: Tensor, largest: float) -> Tensor:
        """Picture of a value of each Gaussian, shape (N,), from violet at 0 to yellow at the largest: (H, W, 3)."""
        blended = self.blend(values.to(self.gaussians.means)[:, None].expand(-1, 3))
        return passes.scalar_colors(blended.color[..., 0], blended.alpha, largest, self.live)

    def normals(self) -> Tensor:
        """Picture of the normals, see :func:`~gaussian_swaying.rendering.passes.normal_colors`, shape (H, W, 3)."""
        own, camera = self.gaussians, self.camera
        blended = self.blend(passes.facing(own.normals, own.means - camera.position.to(own.means)))
        if self.live:
            scene = self.painter.scene
            rotation = scene.frame.direction_to_sim(scene.identity).mT  # its rows are the scene's axes
        else:
            rotation = torch.cat([camera.world_to_camera[:1, :3], -camera.world_to_camera[1:3, :3]])
        return passes.normal_colors(blended.color, blended.alpha, rotation, self.live)

    def pressure(self) -> Tensor:
        """Picture of the force of the wind per area, shape (H, W, 3)."""
        return self.scalar(self.painter.stepper.wind_pressure(self.state), self.force_end)

    def wind(self) -> Tensor:
        """The picture in colour, paler, with streaks of air over it, from violet in still air to yellow.

        A streak is hidden where the object is in front of it, and fades towards its tail. Shape (H, W, 3), on the CPU.
        """
        from PIL import Image, ImageChops, ImageDraw

        stepper, camera, picture = self.painter.stepper, self.camera, self.picture
        places, speeds = (part.cpu() for part in streaks(stepper, self.state, camera))
        largest = speed_scale(stepper) or float(speeds.amax()) or 1.0
        pixel, depth = project(places.reshape(-1, 3), camera)
        pixel, depth = pixel.view(*speeds.shape, 2), depth.view_as(speeds)
        row, column = (pixel[..., k].nan_to_num(-1).clamp(-1, 1e6).floor().long() for k in (1, 0))
        shown = (depth > 1e-3) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
        behind = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        front = mean_depth(picture).reshape(-1)[behind.to(picture.color.device)].to(depth)
        hidden = (front > 0) & (front < depth)
        colours = (255 * colormap(speeds / largest)).tolist()
        ratio = 2  # drawn larger and reduced, so that the lines are smooth
        size = (camera.width * ratio, camera.height * ratio)
        cover, layer = Image.new("L", size), Image.new("RGB", size)  # opacity, and colour times opacity
        cover_pen, layer_pen = ImageDraw.Draw(cover), ImageDraw.Draw(layer)
        thick = max(3, round(0.009 * camera.height * ratio))
        points, visible = (ratio * pixel).tolist(), (shown & ~hidden).tolist()
        for streak, colour, known in zip(points, colours, visible, strict=True):
            for k in range(STEPS):
                if known[k] and known[k + 1]:
                    share = (k + 1) / STEPS
                    ends, width = [tuple(streak[k]), tuple(streak[k + 1])], max(1, round(thick * (0.35 + 0.65 * share)))
                    opacity = round(40 + 215 * share)
                    cover_pen.line(ends, fill=opacity, width=width)
                    layer_pen.line(ends, fill=tuple(round(c * opacity / 255) for c in colour[k]), width=width)
            if known[STEPS]:
                (x, y), r = streak[STEPS], 0.75 * thick
                cover_pen.ellipse([x - r, y - r, x + r, y + r], fill=255)
                layer_pen.ellipse([x - r, y - r, x + r, y + r], fill=tuple(round(c) for c in colour[STEPS]))
        paler = (191.25 * picture.color.detach().float().clamp(0, 1) + 63.75).round().to(torch.uint8).cpu()
        clear = ImageChops.invert(cover.reduce(ratio))
        seen = ImageChops.multiply(Image.fromarray(paler.numpy()), Image.merge("RGB", [clear] * 3))
        over = ImageChops.add(seen, layer.reduce(ratio))
        return torch.frombuffer(bytearray(over.tobytes()), dtype=torch.uint8).view(camera.height, camera.width, 3) / 255

    def vorticity(self) -> Tensor:
        """The picture in colour, paler, with the vorticity of computed air in the plane of the streaks.

        Its part across the plane is drawn: blue turns clockwise as the camera sees it, red the other way, in full
        colour from eight times the flow per longest side of the object on. The object hides what is behind it. Shape
        (H, W, 3), on the CPU.
        """
        stepper, state, camera = self.painter.stepper, self.state, self.camera
        air, frame, moments = stepper.air, stepper.scene.frame, state.air
        assert air is not None
        assert moments is not None
        mean, centre, eye = (part.cpu() for part in _middle(stepper, state, camera))
        axis = torch.linalg.cross(*_plane(mean, (centre - eye) / (centre - eye).norm()))
        axis = axis if float((axis * (eye - centre)).sum()) > 0 else -axis  # towards the camera
        view, intrinsics = camera.world_to_camera.cpu().double(), camera.intrinsics.cpu().double()
        row, column = torch.meshgrid(
            *(torch.arange(n, dtype=torch.float64) + 0.5 for n in (camera.height, camera.width)), indexing="ij"
        )
        x, y = (column - intrinsics[0, 2]) / intrinsics[0, 0], (row - intrinsics[1, 2]) / intrinsics[1, 1]
        ways = torch.stack([x, y, torch.ones_like(x)], -1) @ view[:3, :3]  # a depth of one along each ray, scene units
        ways = frame.point_to_sim((camera.position.cpu().double() + ways).reshape(-1, 3)).view_as(ways) - eye
        depth = ((centre - eye) * axis).sum() / (ways * axis).sum(-1)
        place = (eye + depth.clamp(0, 1e6).nan_to_num(0.0)[..., None] * ways).reshape(-1, 3)
        turning = air.vorticity_at(moments, place.to(state.position)).cpu().double() @ axis
        size = float((state.position.amax(0) - state.position.amin(0)).amax())
        share = turning.view_as(depth) * size / (8 * max(float(mean.norm()), 1e-6))
        seen = mean_depth(self.picture).cpu()
        alpha = (share.abs().clamp(max=1) * (depth > 0) * ~((seen > 0) & (seen < depth)))[..., None].float()
        colours = torch.where(share[..., None] > 0, torch.tensor([0.70, 0.09, 0.17]), torch.tensor([0.13, 0.40, 0.67]))
        under = 0.5 * self.picture.color.detach().cpu().float().clamp(0, 1) + 0.5
        return under * (1 - alpha) + colours * alpha


@fixed
@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a simulation.

    Attributes:
        painter: The painter that draws it.
        editor: The editor whose edits it shows.
        index: Number of the frame; 0 is the frame at rest.
        state: The state at its end.
        health: Energies, momenta, stretch and other measurements.
    """

    painter: Painter
    editor: SceneEditor
    index: int
    state: State
    health: FrameDiagnostics
    _version: int = field(repr=False, default=0)

    def __repr__(self) -> str:
        return f"Frame({self.index}, time={self.time:g})"

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.health.time

    @cached_property
    def gaussians(self) -> DeformedGaussians:
        """All Gaussians in scene units: means, covariances, normals, and colours as the camera sees them."""
        painter = self.painter
        with painter.turn:
            if self.editor.version != self._version:
                raise RuntimeError(
                    f"An edit has changed the colours since frame {self.index}: read `gaussians` or `render()` of a "
                    "frame before the next one."
                )
            return painter.shade(painter.deformed(self.state), painter.camera_at(self.index))

    def render(self, camera: str = "") -> RenderOutput:
        """Render the frame.

        Args:
            camera: Name of one of ``cameras``; empty for the main ``camera``.
        """
        painter, gaussians = self.painter, self.gaussians
        if camera and camera not in painter.cameras:
            known = ", ".join(painter.cameras) or "none"
            raise ValueError(f"There is no camera {camera!r} in `cameras` ({known}): leave it out for the main one.")
        if camera:
            gaussians = painter.shade(gaussians, painter.camera_at(self.index, camera))
        assert gaussians.colors is not None
        return painter.draw(gaussians, gaussians.colors, painter.camera_at(self.index, camera))

    def save(self, path: str | os.PathLike[str], format: str | None = None) -> None:
        """Write the picture of the frame (.png), or its Gaussians as a splat.

        A splat is in scene units; USD in metres with z up, glTF with y up.

        Args:
            path: File to write, such as 0001.ply or 0001.png; an existing one is replaced.
            format: As in :func:`~gaussian_swaying.gaussians.formats.export_cloud`; by default that of the ending.

        Raises:
            FileNotFoundError: If the folder does not exist.
            ValueError: If the ending or the format is unknown, no Gaussian is finite, or the simulation has copies.
            ImportError: If the format is USD and usd-core is not installed.
        """
        if format is None and Path(path).suffix.lower() == ".png":
            check_folder(Path(path))
            pixels = (self.render().color.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
            if is_blank(pixels):
                warnings.warn(f"{path} shows nothing: check the place of the camera and its `near`.", stacklevel=2)
            with atomic(Path(path)) as temporary:
                save_png(temporary, pixels)
            return
        if self.editor.stepper.copies is not None:
            raise ValueError("`copies` cannot be written as a splat yet: write the object alone, without them.")
        place, fps = self.painter.scene.frame, 1 / self.editor.stepper.frame_dt
        export_cloud(
            path, self.gaussians, format=format, fps=fps, metres_per_unit=place.metres_per_unit, rotation=place.rotation
        )


def frames_from(
    painter: Painter,
    editor: SceneEditor,
    state: State,
    first: int,
    count: int,
    drawn: torch.cuda.Stream | None = None,
) -> Iterator[Frame]:
    """The frames of a simulation from number ``first`` up to ``count``, with its edits.

    Args:
        state: The state at rest if ``first`` is 0, otherwise the state of the frame before.
        drawn: A stream on which the frames are drawn and recorded. The next frame is then simulated at the same time,
            so that the GPU does not wait for the host, and what is assigned between two frames applies from the next
            but one on.
    """
    stepper, started = editor.stepper, editor.stepper.starts

    def frames(state: State) -> Iterator[Frame]:
        launched: Launched | None = None
        for index in range(first, count):
            with stepper.turn:
                if stepper.starts != started:
                    raise RuntimeError(
                        "This simulation was started again, so the earlier loop over its frames cannot go on: finish "
                        "one loop before the next, or make a Simulation for each."
                    )
                if index == 0:
                    health = stepper.at_first(state).read()
                else:
                    if launched is None and stepper.progress is not None:
                        stepper.progress.begin(index)
                    state, health = stepper.advance(state) if launched is None else launched.finish()
                    if drawn is not None:  # the frame before may still be drawn from memory that is now free
                        torch.cuda.current_stream(stepper.device).wait_stream(drawn)
                    state = editor.edit_due(state)
                if drawn is not None and index + 1 < count:
                    drawn.wait_stream(torch.cuda.current_stream(stepper.device))
                    if stepper.progress is not None:
                        stepper.progress.begin(index + 1)
                    launched = stepper.launch(state)
                frame = Frame(painter, editor, index, state, health, editor.version)
            yield frame

    return frames(state)
