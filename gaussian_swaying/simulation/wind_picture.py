"""The wind in pictures, over the picture of the object: streaks that drift with it, and vorticity of computed air."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.rendering.passes import colormap, mean_depth
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.stepper import Stepper
from gaussian_swaying.wind.field import WindField

ACROSS = 26
"""Streaks along the longer side of the picture."""

STEPS = 12
"""Straight pieces of a streak."""


def streaks(stepper: Stepper, state: State, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pieces of the lines along which the air flows at one moment, near a plane through the object.

    The plane contains the direction of the flow, and is upright or level, whichever the camera sees better. They start
    at the points of a lattice that drifts with the mean flow, so that they move from frame to frame as the air does,
    and are as long as the air flows in a fixed time: an eighth of the picture at the speed of the flow.

    Args:
        stepper: The stepper of the simulation.
        state: The state.
        camera: The camera, in scene units.

    Returns:
        Places, scene units, shape (S, STEPS + 1, 3), and the speed at them [m/s], shape (S, STEPS + 1).
    """
    frame, wind = stepper.scene.frame, stepper.setup.wind
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
    device, frame, wind = state.position.device, stepper.scene.frame, stepper.setup.wind
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


def draw_wind(
    stepper: Stepper, state: State, camera: Camera, picture: RenderOutput, largest: float | None = None
) -> Tensor:
    """The picture of the object, paler, with streaks of air over it, from violet in still air to yellow.

    A streak is hidden where the object is in front of it, and fades towards its tail.

    Args:
        stepper: The stepper of the simulation.
        state: The state.
        camera: The camera, on the device of the Gaussians.
        picture: Picture of the object from the camera.
        largest: End of the colour scale [m/s]; 1.5 times the mean flow if None.

    Returns:
        Shape (H, W, 3), on the CPU.
    """
    from PIL import Image, ImageChops, ImageDraw

    places, speeds = (part.cpu() for part in streaks(stepper, state, camera))
    largest = largest or speed_scale(stepper) or float(speeds.amax()) or 1.0
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


def draw_vorticity(stepper: Stepper, state: State, camera: Camera, picture: RenderOutput) -> Tensor:
    """The picture of the object, paler, with the vorticity of computed air in the plane of the streaks.

    Its part across the plane is drawn: blue turns clockwise as the camera sees it, red the other way, in full colour
    from eight times the flow per longest side of the object on. The object hides what is behind it.

    Args:
        stepper: The stepper of the simulation, with computed air.
        state: The state.
        camera: The camera, on the device of the Gaussians.
        picture: Picture of the object from the camera.

    Returns:
        Shape (H, W, 3), on the CPU.
    """
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
    seen = mean_depth(picture).cpu()
    alpha = (share.abs().clamp(max=1) * (depth > 0) * ~((seen > 0) & (seen < depth)))[..., None].float()
    colours = torch.where(share[..., None] > 0, torch.tensor([0.70, 0.09, 0.17]), torch.tensor([0.13, 0.40, 0.67]))
    under = 0.5 * picture.color.detach().cpu().float().clamp(0, 1) + 0.5
    return under * (1 - alpha) + colours * alpha
