"""Readers of winds made or measured elsewhere: TurbSim's .bts, NetCDF, .npz, and the CSV of an anemometer."""

from __future__ import annotations

import csv
import math
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying._inputs import check_regular, read_arrays

LARGEST = 1 << 32
"""Largest file of a wind [bytes]."""

LONGEST_STEP = 1e6
"""Largest step of a grid [m], and the inverse of the smallest; no wind is known on finer or coarser ones."""

_METRES = ("", "m", "meter", "meters", "metre", "metres")
_SPEEDS = ("", "m/s", "ms-1", "ms^-1", "ms**-1", "meterspersecond", "metrespersecond")


@dataclass(frozen=True)
class GridWind:
    """Velocities on a regular grid.

    Attributes:
        velocity: [m/s], shape (T, X, Y, Z, 3), float32.
        first: Place of the first corner [m], three numbers.
        spacing: Sides of a cell [m], three numbers.
        times: Of the fields [s], shape (T,), float64.
    """

    velocity: np.ndarray
    first: tuple[float, float, float]
    spacing: tuple[float, float, float]
    times: np.ndarray


@dataclass(frozen=True)
class TurbSimWind:
    """A file of TurbSim: a plane across the wind at regular times.

    Attributes:
        velocity: [m/s], shape (T, Y, Z, 3), float32: along the wind, to the left of it, up.
        spacing: Sides of a cell [m], across and up.
        dt: Time between planes [s].
        speed: Mean wind at the hub [m/s].
        bottom: Height of the lowest row [m].
    """

    velocity: np.ndarray
    spacing: tuple[float, float]
    dt: float
    speed: float
    bottom: float


def read_bts(path: str | os.PathLike[str]) -> TurbSimWind:
    """Read a full-field file of TurbSim (Jonkman 2009, NREL/TP-500-46198, table E-1)."""
    path = check_regular(path, "the wind", LARGEST)
    data = path.read_bytes()
    head = struct.Struct("<h4i12fi")
    if len(data) < head.size or struct.unpack_from("<h", data)[0] not in (7, 8):
        raise ValueError(f"{path} is not a full-field file of TurbSim (.bts): write one with WrADFF = True.")
    _, nz, ny, towers, nt, dz, dy, dt, speed, hub, bottom, *scales, letters = head.unpack_from(data)
    start = head.size + letters
    count = nt * (ny * nz + towers) * 3
    sizes = (nz >= 1, ny >= 2, nt >= 2, towers >= 0, letters >= 0, dt > 0, speed > 0, _is_step(dz), _is_step(dy))
    slopes = np.array(scales[::2], dtype=np.float64)
    finite = np.isfinite([*scales, dt, speed, hub, bottom]).all()
    if not all(sizes) or not (finite and slopes.all()) or len(data) != start + 2 * count:
        raise ValueError(
            f"{path} is damaged: its header says {ny} x {nz} points, {dy:g} m and {dz:g} m apart, and {nt} times, "
            f"which does not fit its {len(data):,} bytes or is no grid; run TurbSim again."
        )
    raw = np.frombuffer(data, "<i2", count, start).reshape(nt, -1, 3)[:, : ny * nz].reshape(nt, nz, ny, 3)
    velocity = ((raw - np.array(scales[1::2])) / slopes).astype(np.float32).transpose(0, 2, 1, 3)
    return TurbSimWind(np.ascontiguousarray(velocity), (dy, dz), dt, speed, bottom)


def read_grid(path: str | os.PathLike[str]) -> GridWind:
    """Read a wind on a regular grid: .npz, or .nc with netCDF4, or scipy where that is not installed.

    A .npz has ``x``, ``y``, ``z`` [m] and ``velocity`` [m/s] of shape (X, Y, Z, 3), or ``time`` [s] as well and
    (T, X, Y, Z, 3). A .nc has coordinates with these names, of any order, and one variable with an axis ``uvw`` (as
    hipersim writes) or three: ``u``, ``v`` and ``w``. If units are given, they must be metres and seconds.
    """
    path = check_regular(path, "the wind", LARGEST)
    if path.suffix == ".npz":
        found = read_arrays(path, "the wind", ("x", "y", "z", "velocity"), ("time", "units"))
        _check_units(path, "velocity", str(found.get("units", "")), _SPEEDS)
        names: list[str] = [name for name in ("time", *"xyz") if name in found]
        axes, velocity = {name: found[name] for name in names}, found["velocity"]
    elif path.suffix in (".nc", ".nc4"):
        axes, velocity = _read_netcdf(path)
    else:
        raise ValueError(f"{path} is not a wind that can be read: give a .npz, .nc or .bts file.")
    return _checked(path, axes, velocity)


def _checked(path: Path, axes: dict[str, np.ndarray], velocity: np.ndarray) -> GridWind:
    axes = {name: _numbers(path, name, axis) for name, axis in axes.items()}
    times = axes.get("time", np.zeros(1))
    if len(times) == 0:
        raise ValueError(f"`time` in {path} is empty: save at least one field.")
    if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise ValueError(f"Expected `time` in {path} to rise, without NaN: sort the fields by time.")
    if "time" not in axes:
        velocity = velocity[None] if velocity.ndim == 4 else velocity
    shape = (len(times), *(len(axes[name]) for name in "xyz"), 3)
    if velocity.shape != shape:
        raise ValueError(
            f"The velocity in {path} has the shape {tuple(velocity.shape)}, but its axes (time, x, y, z) and three "
            f"components need {shape}: save it in this order."
        )
    first, spacing = [], []
    for name in "xyz":
        axis = axes[name]
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.diff(axis)
            rises = len(axis) > 1 and bool((steps > 0).all() and np.isfinite(steps).all())
            step = float(steps.mean()) if rises else 0.0
        if not rises or np.ptp(steps) > 1e-3 * step:
            raise ValueError(
                f"Expected `{name}` in {path} to rise in equal steps, with at least two values: interpolate the wind "
                "to a regular grid first."
            )
        if not _is_step(step):
            raise ValueError(f"The steps of `{name}` in {path} are {step:.3g} m: save its places in metres.")
        first.append(float(axis[0]))
        spacing.append(step)
    if velocity.dtype.kind not in "iuf":
        raise ValueError(f"The velocity in {path} is not made of numbers: save it as float32.")
    with np.errstate(over="ignore"):
        velocity = velocity.astype(np.float32)
    if not np.isfinite(velocity).all():
        count = int((~np.isfinite(velocity)).sum())
        raise ValueError(f"{count} velocities in {path} are NaN or infinite: fill them first.")
    return GridWind(velocity, (first[0], first[1], first[2]), (spacing[0], spacing[1], spacing[2]), times)


def _is_step(length: float) -> bool:
    """True if a length [m] is allowed for the side of a cell of a wind."""
    return bool(1 / LONGEST_STEP <= length <= LONGEST_STEP)


def _numbers(path: Path, name: str, axis: np.ndarray) -> np.ndarray:
    """An axis as float64, shape (N,)."""
    axis = np.asarray(axis)
    if axis.ndim != 1 or axis.dtype.kind not in "iuf":
        raise ValueError(f"Expected `{name}` in {path} to be a list of numbers: save it as an array of one dimension.")
    return axis.astype(np.float64)


def _read_netcdf(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Axes by name, and the velocities, shape (T, X, Y, Z, 3) or (X, Y, Z, 3)."""
    try:
        import netCDF4
    except ImportError:
        from scipy.io import netcdf_file

        try:
            file: Any = netcdf_file(path, "r", mmap=False)
        except (TypeError, ValueError, OSError, IndexError) as error:
            raise ValueError(
                f"{path} cannot be read with scipy ({error}): install gaussian-swaying[netcdf] for files in HDF5."
            ) from error
    else:
        try:
            file = netCDF4.Dataset(path)
        except OSError as error:
            raise ValueError(f"{path} cannot be read ({error}): write it again.") from error
        file.set_auto_mask(False)
    with file:
        variables = file.variables
        axes = {}
        for name, known in (("time", ("", "s", "sec", "second", "seconds")), *((n, _METRES) for n in "xyz")):
            if name in variables:
                _check_units(path, name, _units(variables[name]), known)
                axes[name] = np.array(variables[name][:], dtype=np.float64)
        for name in "xyz":
            if name not in axes:
                raise ValueError(f"{path} has no axis `{name}`: name its axes time, x, y and z, in s and m.")
        order = [name for name in ("time", *"xyz") if name in axes]
        if all(name in variables for name in "uvw") and set(variables["u"].dimensions) == set(order):
            parts = [_turned(path, variables[name], order) for name in "uvw"]
            return axes, np.stack(parts, axis=-1)
        for variable in variables.values():
            if set(variable.dimensions) == {*order, "uvw"}:
                return axes, _turned(path, variable, [*order, "uvw"])
    raise ValueError(
        f"{path} has no velocity on its axes {', '.join(order)}: it needs `u`, `v` and `w`, or one variable with an "
        "axis `uvw` as well."
    )


def _turned(path: Path, variable: Any, order: list[str]) -> np.ndarray:
    _check_units(path, "velocity", _units(variable), _SPEEDS)
    if set(variable.dimensions) != set(order):
        raise ValueError(f"The components in {path} have different axes: save all on {', '.join(order)}.")
    return np.array(variable[:]).transpose([variable.dimensions.index(name) for name in order])


def _units(variable: Any) -> str:
    units = getattr(variable, "units", "")
    return units.decode() if isinstance(units, bytes) else str(units)


def _plain(units: str) -> str:
    return re.sub(r"[\s.·]", "", units).lower()


def _check_units(path: Path, name: str, units: str, known: tuple[str, ...]) -> None:
    if _plain(units.split(" since ")[0]) not in known:
        raise ValueError(f"`{name}` in {path} is in {units!r}, not in {known[1]}: convert it first.")


def _of_toa5(path: Path, rows: list[list[str]]) -> list[list[str]]:
    """The rows of a TOA5 file as those of a CSV: names with units, then seconds and velocities."""
    if len(rows) < 4:
        raise ValueError(f"{path} ends within the four lines of its head: export it again.")
    known = {"TIMESTAMP": "time", "Ux": "u", "Uy": "v", "Uz": "w"}
    wanted = [place for place, name in enumerate(rows[1]) if name in known and place < len(rows[2])]
    units = ["s" if rows[2][place] == "TS" else rows[2][place] for place in wanted]
    found = [[f"{known[rows[1][place]]} [{unit}]" for place, unit in zip(wanted, units, strict=True)]]
    start: Any = None
    at = next((at for at, place in enumerate(wanted) if rows[1][place] == "TIMESTAMP"), None)
    for line, row in enumerate(rows[4:], start=5):
        cells = [row[place] if place < len(row) else "" for place in wanted]
        if at is not None:
            try:
                now = np.datetime64(cells[at])
            except ValueError as error:
                raise ValueError(f"Line {line} of {path} has no time ({error}): fill or remove it.") from error
            start = now if start is None else start
            cells[at] = str((now - start) / np.timedelta64(1, "s"))
        found.append(cells)
    return found


def read_anemometer(path: str | os.PathLike[str]) -> tuple[list[float], list[list[float]]]:
    """Read the time series of an anemometer: a CSV with one line of names, or a logger's TOA5 file.

    Its columns are ``time [s]``, and either ``u [m/s]``, ``v [m/s]`` and perhaps ``w [m/s]`` (along x, y and z), or
    ``speed [m/s]`` and ``direction [deg]`` (from which the wind blows, clockwise from north, where y is north and x is
    east). The units may be left out, but others are an error. Other columns are ignored. A TOA5 file (Campbell
    Scientific) has ``TIMESTAMP`` and ``Ux``, ``Uy`` and ``Uz``, along x, y and z; its first record is time zero.

    Returns:
        Times [s] and velocities [m/s], z up.
    """
    path = check_regular(path, "the time series", 1 << 28)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV in UTF-8 ({error}): export it again.") from error
    head = 1  # lines before the measurements
    if rows and rows[0][0] == "TOA5":
        rows, head = _of_toa5(path, rows), 4
    known = {"time": ("", "s"), "direction": ("", "deg", "°"), **dict.fromkeys(("u", "v", "w", "speed"), ("", "m/s"))}
    columns: dict[str, int] = {}
    for number, cell in enumerate(rows[0] if rows else []):
        match = re.fullmatch(r"\s*([A-Za-z]+)\s*(?:[\[(](.*)[\])])?\s*", cell)
        name = match[1].lower() if match else ""
        if match and name in known:
            _check_units(path, name, match[2] or "", known[name])
            if name in columns:
                raise ValueError(f"{path} has two columns `{name}`: remove or rename one.")
            columns[name] = number
    polar = "speed" in columns
    needed = ("time", "speed", "direction") if polar else ("time", "u", "v")
    for name in needed:
        if name not in columns:
            raise ValueError(
                f"{path} has no column `{name} [{known[name][1]}]`: it needs time, and u and v or speed and direction."
            )
    wanted = [*needed, *(["w"] if "w" in columns else [])]
    times, flows = [], []
    for line, row in enumerate(rows[1:], start=head + 1):
        try:
            numbers = [float(row[columns[name]]) for name in wanted]
        except (ValueError, IndexError):
            numbers = [math.nan]
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"Line {line} of {path} has no number for each of {', '.join(wanted)}: fill or remove it.")
        time, first, second, *up = numbers
        if polar:
            angle = math.radians(second)
            first, second = -first * math.sin(angle), -first * math.cos(angle)
        times.append(time)
        flows.append([first, second, *(up or [0.0])])
    if not times:
        raise ValueError(f"{path} has no measurements: check the file.")
    return times, flows
