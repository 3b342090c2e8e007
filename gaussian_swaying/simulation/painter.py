"""Pictures of a simulated scene: cameras, colours and renders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._fixed import Fixed
from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.kernels.graphs import RECORDED, Replayed, fingerprint
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.layout import check_camera_name
from gaussian_swaying.rendering import passes
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.cameras.camera_path import CameraPath, OrbitCamera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.protocol import Renderer, RenderOutput
from gaussian_swaying.rendering.shading import Shader
from gaussian_swaying.simulation.simulated_scene import SimulatedScene

MAX_PIXELS = 1 << 26  # per picture: twice as many as 8K


class Painter(Fixed, nn.Module):
    """Draws a simulated scene from its cameras.

    Args:
        scene: The Gaussians, and how they follow the material.
        shader: Colours from normals and light; None keeps the colours of the splat.
        camera: Camera path; an orbit camera if None.
        cameras: Further cameras by name.
        background: Background colour, in [0, 1].
        frame_dt: Time between frames [s].
        renderer: Draws the Gaussians; by default gsplat on CUDA and the torch renderer elsewhere, chosen at the first
            picture.

    Raises:
        ValueError: If the background or the name of a camera is invalid.
    """

    assignable = ("shader", "camera", "cameras", "background", "frame_dt")

    def __init__(
        self,
        scene: SimulatedScene,
        shader: Shader | None = None,
        camera: CameraPath | None = None,
        cameras: Mapping[str, CameraPath] | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        frame_dt: float = 0.04,
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__()
        if not all(0 <= value <= 1 for value in background):
            raise ValueError(f"Expected `background` within [0, 1], but got {list(background)}: 1 is white, not 255.")
        self.scene, self.shader, self.frame_dt = scene, shader, float(frame_dt)
        origin = scene.model.origin
        self.camera = (camera or OrbitCamera()).counted_from(origin)
        self.cameras = {name: path.counted_from(origin) for name, path in (cameras or {}).items()}
        for name in self.cameras:
            check_camera_name(name)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32))
        self.background: Tensor
        self._renderer = renderer
        self.turn = Turn()
        """The lock of the thread that steps or draws the simulation."""
        self._moved, self._coloured = Replayed(), Replayed()
        self._rest: tuple[Camera, object, Tensor, Tensor] | None = None  # of many Gaussians that do not move
        self._still: dict[str, tuple[tuple[object, ...], Camera]] = {}  # cameras of the last frame that do not move

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
            frame: Frame number.
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
        return path(frame, frame * self.frame_dt, self.center, self.scene.frame.rotation[2], self.size)

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
        found = self._moved((fingerprint([scene]), follow.layout(state)), moved, *given)
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
            view, colours = seen_from(harmonics, eye, means[index], turned)
            return still.index_copy(0, index, self._shaded(colours, gaussians.normals[index], view))
        given = [eye, means, gaussians.normals]
        given += [gaussians.rotations] if scene.model.view_dependent else []
        if len(means) > RECORDED or not (shader is None or shader.recordable):
            return self._colors(*given)
        key = fingerprint([scene, *([] if shader is None else [shader])])
        return self._coloured(key, lambda *known: [self._colors(*known)], *given)[0]

    def _colors(self, eye: Tensor, means: Tensor, normals: Tensor, rotations: Tensor | None = None) -> Tensor:
        scene, index = self.scene, self.scene.moving
        view, colours = seen_from(scene.model.sh, eye, means, rotations)
        if scene.all_move:
            return self._shaded(colours, normals, view)
        if self.shader is None:
            return colours
        return colours.index_copy(0, index, self._shaded(colours[index], normals[index], view[index]))

    def _shaded(self, colours: Tensor, normals: Tensor, view: Tensor) -> Tensor:
        if self.shader is None:
            return colours
        scene = self.scene
        normal, to_eye = (scene.frame.direction_to_sim(part) for part in (normals, -view))
        return self.shader(colours, normal, rest_normal=scene.rest_facing, view_direction=to_eye)

    def _still_colours(self, camera: Camera, eye: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (N, 3) of all Gaussians at rest, and the harmonics of those that move; kept for the last camera.

        They are not kept where gradients are wanted, or where a change in place cannot be seen.
        """
        model = self.scene.model
        parts = (model.means, model.sh0, model.shN, camera.world_to_camera)
        if any(part.is_inference() or (part.requires_grad and torch.is_grad_enabled()) for part in parts):
            return self._rest_colours(eye)
        key = (fingerprint([self.scene]), *(part._version for part in parts))
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
        """The same Gaussians with their colours as a camera sees them."""
        return replace(gaussians, colors=self.colors(gaussians, camera))

    @in_turn
    def draw(self, gaussians: DeformedGaussians, colours: Tensor, camera: Camera) -> RenderOutput:
        """Draw Gaussians in scene units."""
        return self.renderer(gaussians.means, gaussians.covariances, self.opacity(), colours, camera, self.background)

    @in_turn
    def render(self, state: State, frame: int, name: str = "") -> RenderOutput:
        """The picture of a state from the camera of a frame.

        Args:
            state: The state.
            frame: Frame number.
            name: Which of ``cameras``; empty for ``camera``.
        """
        return self.picture(self.deformed(state), self.camera_at(frame, name))

    def picture(self, gaussians: DeformedGaussians, camera: Camera) -> RenderOutput:
        """The picture of Gaussians in scene units with their own colours, from a camera on their device."""
        return self.draw(gaussians, self.colors(gaussians, camera), camera)

    def draw_normals(
        self, gaussians: DeformedGaussians, camera: Camera, axes: str = "camera", smooth: bool = False
    ) -> Tensor:
        """Picture of the normals, see :func:`~gaussian_swaying.rendering.passes.normal_colors`, shape (H, W, 3).

        Args:
            gaussians: In scene units.
            camera: The camera, on the device of the Gaussians.
            axes: ``camera`` (x right, y up, z towards the camera) or ``world`` (z up).
            smooth: Whether edges fade to black instead of ending at a pixel.
        """
        normals = passes.facing(gaussians.normals, gaussians.means - camera.position.to(gaussians.means))
        picture = self._draw(gaussians, normals, camera)
        if axes == "world":
            rotation = self.scene.frame.direction_to_sim(self.scene.identity).mT  # its rows are the scene's axes
        else:
            rotation = torch.cat([camera.world_to_camera[:1, :3], -camera.world_to_camera[1:3, :3]])
        return passes.normal_colors(picture.color, picture.alpha, rotation, smooth)

    def draw_pressure(
        self,
        pressure: Tensor,
        gaussians: DeformedGaussians,
        camera: Camera,
        largest: float,
        smooth: bool = False,
    ) -> Tensor:
        """Picture of a force per area, with a colour scale that ends at ``largest`` [Pa], shape (H, W, 3).

        Args:
            pressure: Force per area of each Gaussian [Pa], shape (N,).
            gaussians: In scene units.
            camera: The camera, on the device of the Gaussians.
            largest: End of the colour scale [Pa].
            smooth: Whether edges fade to black instead of ending at a pixel.
        """
        shown = pressure.to(gaussians.means)
        picture = self._draw(gaussians, shown[:, None].expand(-1, 3), camera)
        return passes.scalar_colors(picture.color[..., 0], picture.alpha, largest, smooth)

    def _draw(self, gaussians: DeformedGaussians, values: Tensor, camera: Camera) -> RenderOutput:
        return self.renderer(gaussians.means, gaussians.covariances, self.opacity(), values, camera)

    def opacity(self) -> Tensor:
        """Opacities of the Gaussians that are drawn, shape (N,)."""
        return self.scene.model.opacity()

    def depth_range(self, frame: int, name: str) -> tuple[float, float]:
        """Ends of the depth's colour scale [scene units]: one longest side before and behind the object's centre."""
        distance = float((self._camera(frame, name).position.to(self.center) - self.center).norm())
        return distance - self.size, distance + self.size


def seen_from(sh: Tensor, eye: Tensor, means: Tensor, rotations: Tensor | None) -> tuple[Tensor, Tensor]:
    """Directions from the eye, and colours from there in the rest frame of each Gaussian, both (N, 3)."""
    view = torch.nn.functional.normalize(means - eye, dim=-1)
    at_rest = view if rotations is None else (view[..., None] * rotations).sum(-2)
    return view, sh_to_color(sh, at_rest)
