"""Cameras that move along a path given by a few keys."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import fixed
from gaussian_swaying.rendering.cameras.camera import check_elevation, check_fov


def interpolate_keys(times: Sequence[float], values: Sequence[Sequence[float]], time: float) -> list[float]:
    """Values between keys; constant before the first and after the last.

    This is the monotone cubic of Fritsch & Butland 1984 ("A method for constructing local monotone piecewise
    cubic interpolants") with slope zero at both ends. Each number and its rate are continuous at all times, and between
    two keys no number leaves the range of the two.

    Args:
        times: Increasing times [s], K of them.
        time: Time [s].

    Example:
        >>> interpolate_keys([0.0, 2.0], [[0.0], [8.0]], 0.5)
        [1.25]
    """
    if time <= times[0] or len(times) == 1:
        return list(values[0])
    if time >= times[-1]:
        return list(values[-1])
    k = bisect_right(times, time) - 1
    span = times[k + 1] - times[k]
    s = (time - times[k]) / span
    between = []
    for d, (start, end) in enumerate(zip(values[k], values[k + 1], strict=True)):
        before, after = (_slope(times, [row[d] for row in values], at) for at in (k, k + 1))
        ease = s * s * (3 - 2 * s)
        between.append(start + ease * (end - start) + span * s * (1 - s) * ((1 - s) * before - s * after))
    return between


def _slope(times: Sequence[float], values: Sequence[float], k: int) -> float:
    if not 0 < k < len(times) - 1:
        return 0.0
    left, right = times[k] - times[k - 1], times[k + 1] - times[k]
    before, after = (values[k] - values[k - 1]) / left, (values[k + 1] - values[k]) / right
    if before * after <= 0:
        return 0.0
    first, second = 2 * right + left, right + 2 * left
    return (first + second) / (first / before + second / after)


@fixed
@dataclass
class CameraKey:
    """A camera at one time; null values stay as in the key before.

    Args:
        time: Time [s].
        eye: Position [scene units], 3 numbers; or give ``azimuth``, ``elevation`` and ``radius``.
        azimuth: Angle about the up direction [degrees], as for OrbitCamera; may exceed 360 for full turns.
        elevation: Angle above the horizontal plane [degrees], between -90 and 90 (both excluded).
        radius: Distance from the target, in multiples of the object's longest side.
        target: Point at the image centre [scene units], 3 numbers; null in the first key for the object's centre.
        fov_y: Vertical field of view [degrees]; null in the first key for that of the camera.
    """

    time: float
    eye: list[float] | None = None
    azimuth: float | None = None
    elevation: float | None = None
    radius: float | None = None
    target: list[float] | None = None
    fov_y: float | None = None


class KeyedCamera:
    """Keys, filled up: the place, the target and the field of view at a time.

    Args:
        keys: Times and positions, sorted by time.
        fov_y: Field of view of keys that give none [degrees].

    Attributes:
        orbits: Whether places are azimuth, elevation and radius.
    """

    def __init__(self, keys: Sequence[CameraKey], fov_y: float) -> None:
        if not keys:
            raise ValueError("Expected `keys` to hold at least one key with a time and a position.")
        self.times = [check_vector("keys.time", [key.time], 1)[0] for key in keys]
        if any(a >= b for a, b in pairwise(self.times)):
            raise ValueError(f"Expected the times of `keys` to increase, but got {self.times}.")
        on_sphere = [any(getattr(key, name) is not None for name in _ANGLES) for key in keys]
        with_eye = [key.eye is not None for key in keys]
        if any(on_sphere) == any(with_eye):
            raise ValueError(
                "Expected `keys` to give either `eye`, or `azimuth`, `elevation` and `radius`, "
                f"but got {'both' if any(with_eye) else 'neither'}."
            )
        self.orbits = any(on_sphere)
        if self.orbits:
            columns = [_carried_on(name, [getattr(key, name) for key in keys]) for name in _ANGLES]
            self.places = [list(row) for row in zip(*columns, strict=True)]
            for _, elevation, radius in self.places:
                check_elevation("keys.elevation", elevation)
                check_positive("keys.radius", radius)
        else:
            eyes = _carried_on("eye", [key.eye for key in keys])
            self.places = [list(check_vector("keys.eye", eye)) for eye in eyes]
        targets = _filled([key.target for key in keys], None)
        self.targets = [None if target is None else check_vector("keys.target", target) for target in targets]
        for place, target in zip(self.places, self.targets, strict=True):
            if not self.orbits and target is not None and place == list(target):
                raise ValueError(f"Expected `eye` and `target` to differ, but both are {place}.")
        self.fovs = [[check_fov("keys.fov_y", value)] for value in _filled([key.fov_y for key in keys], fov_y)]

    def at(self, time: float, middle: Sequence[float]) -> tuple[list[float], list[float], float]:
        """Place, target and field of view [degrees] at a time [s]; ``middle`` is the target of keys without one."""
        targets = [middle if target is None else target for target in self.targets]
        place, target, (fov,) = (
            interpolate_keys(self.times, values, time) for values in (self.places, targets, self.fovs)
        )
        return place, target, fov


_ANGLES = ("azimuth", "elevation", "radius")


def _filled(values: list[Any], first: Any) -> list[Any]:
    filled = []
    for value in values:
        first = first if value is None else value
        filled.append(first)
    return filled


def _carried_on(name: str, values: list[Any]) -> list[Any]:
    if values[0] is None:
        raise ValueError(f"The first of the `keys` has no `{name}`: only later keys may leave it out.")
    return _filled(values, None)
