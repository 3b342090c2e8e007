"""The camera of a PhysGaussian configuration: ``camera``."""

from __future__ import annotations

from typing import Any

from gaussian_swaying.interop.physgaussian.fields import Fields, Notes
from gaussian_swaying.interop.physgaussian.parts import part
from gaussian_swaying.interop.physgaussian.space import CENTER


def camera_settings(take: Fields, cameras: str | None, notes: Notes) -> dict[str, Any]:
    """``camera``: a camera of the model, the moving camera, or our orbit camera if the file of cameras is missing."""
    viewpoint = list(take.vector("mpm_space_viewpoint_center", CENTER))
    up = list(take.vector("mpm_space_vertical_upward_axis", (0.0, 0.0, 1.0)))
    index = take.whole("default_camera_index", 0, least=-1)
    names = ("init_azimuthm", "init_elevation", "init_radius")
    start = {name: take.get(name, None) for name in names}
    deltas = {name: take.get(name, None) for name in ("delta_a", "delta_e", "delta_r")}
    moves = take.flag("move_camera", False)
    if take.flag("show_hint", False):
        notes.add("`show_hint` has no effect: PhysGaussian prints the camera's angles and stops.")
    orbit = "gaussian_swaying.interop.physgaussian.camera.PhysGaussianCamera"
    if index >= 0 and cameras is None:
        notes.add(
            f"`default_camera_index` {index} is a camera of the 3DGS model, whose cameras.json was not given, so it is "
            f"an orbit here; --camera {orbit} --camera.cameras PATH --camera.index {index} uses the model's."
        )
        return part("OrbitCamera", width=960, height=540)
    if index >= 0:
        return part(orbit, cameras=cameras, index=index)
    wanted = [*start, *deltas] if moves else list(start)
    for name in wanted:
        if (start | deltas)[name] is None:
            raise ValueError(f"The key `{name}` is missing, but `default_camera_index` -1 needs it.")
        take.number(name)
    if cameras is None:
        notes.add(
            "`default_camera_index` -1: PhysGaussian takes lens and size of the picture from the model's cameras.json; "
            "here they are those of `camera`."
        )
    change = [float(d) for d in deltas.values()] if moves else [0.0] * 3
    return part(
        orbit,
        cameras=cameras,
        azimuth=float(start["init_azimuthm"]),
        elevation=float(start["init_elevation"]),
        radius=float(start["init_radius"]),
        delta_azimuth=change[0],
        delta_elevation=change[1],
        delta_radius=change[2],
        viewpoint=viewpoint,
        up=up,
    )


__all__ = ["camera_settings"]
