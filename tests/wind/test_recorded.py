"""Winds from files: what is read, and that a file that does not fit is refused with a sentence."""

import math
import struct

import numpy as np
import pytest
import torch
from shared import EYE, double, value_error
from torch.testing import assert_close

from gaussian_swaying import WindField
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.tables import FrozenWind, RecordedWind
from gaussian_swaying.wind.wind_files import read_anemometer, read_bts, read_grid


def _linear(t, x, y, z):
    """Linear in time and place, so that interpolation is exact."""
    return np.stack([t + 2 * x + 0 * y + 0 * z, y - x + 0 * z, 3 * z - t + 0 * x * y], axis=-1)


AXES = {
    "time": np.array([5.0, 6.0, 8.0]),
    "x": np.linspace(-1, 2, 4),
    "y": np.linspace(0, 1, 3),
    "z": np.array([0, 2.0]),
}


def _npz(path, **changes):
    t, x, y, z = np.meshgrid(*AXES.values(), indexing="ij")
    np.savez(path, **(AXES | {"velocity": _linear(t, x, y, z)} | changes))
    return path


def test_a_recorded_wind_is_exact_where_it_is_linear(tmp_path):
    wind = WindField(effects=[RecordedWind(_npz(tmp_path / "w.npz"), origin=[10.0, 0.0, 0.0])])
    place = double([[10.3, 0.2, 1.7], [9.1, 0.9, 0.1]])
    for time in (0.0, 0.4, 1.0, 2.5, 3.0):
        x, y, z = (place - torch.tensor([10.0, 0.0, 0.0])).unbind(-1)
        expected = _linear(5 + time, x.numpy(), y.numpy(), z.numpy())
        np.testing.assert_allclose(wind.at(double(time), place).numpy(), expected, atol=2e-6)  # the table is float32
    assert_close(wind.at(double(100.0), place), wind.at(double(3.0), place))
    outside = wind.at(double(1.0), double([[50.0, -7.0, 9.0]]))
    np.testing.assert_allclose(outside[0].numpy(), _linear(6.0, 2.0, 0.0, 2.0), atol=2e-6)


def test_a_recorded_wind_repeats(tmp_path):
    effect = RecordedWind(_npz(tmp_path / "w.npz"), repeat=True, start=6.0)
    wind = WindField(effects=[effect])
    place = double([[0.3, 0.2, 1.7]])
    assert effect.period == pytest.approx(4.5)
    assert_close(wind.at(double(0.7 + 4.5), place), wind.at(double(0.7), place))
    between = wind.at(double(2.75), place)  # 8.75: in the middle of the last step
    assert_close(between, 0.5 * (wind.at(double(2.0), place) + wind.at(double(3.5), place)))


def test_places_of_the_file_are_in_metres_and_its_origin_in_scene_units(tmp_path):
    frame = SimFrame(double([1.0, 0.0, 0.0]), EYE, 2.0)
    moved = RecordedWind(_npz(tmp_path / "w.npz"), origin=[2.0, 0.5, 0.0]).in_frame(frame)
    moment = Moment(double(0.0), double([0.0] * 3), double([0.0] * 3), double(1.0))
    found = moved(torch.zeros(3), double([[2.5, 1.2, 0.4]]), moment)
    np.testing.assert_allclose(found[0].numpy(), _linear(5.0, 0.5, 0.2, 0.4), atol=2e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"x": np.array([0.0, 1.0, 2.0, 4.0])}, "`x` in .* to rise in equal steps"),
        ({"x": np.linspace(2, -1, 4)}, "`x` in .* to rise in equal steps"),
        ({"time": np.array([1.0, 0.0, 2.0])}, "`time` in .* to rise"),
        ({"y": np.linspace(0, 1, 4)}, r"shape \(3, 4, 3, 2, 3\), but its axes .* need \(3, 4, 4, 2, 3\)"),
        ({"velocity": np.full((3, 4, 3, 2, 3), np.nan)}, "216 velocities"),
        ({"velocity": np.full((3, 4, 3, 2, 3), 1e39)}, "216 velocities"),
        ({"velocity": np.full((3, 4, 3, 2, 3), "5")}, "not made of numbers"),
        ({"time": np.zeros(0), "velocity": np.zeros((0, 4, 3, 2, 3))}, "`time` in .* is empty: save at least one"),
        ({"time": np.array([0.0, 1.0, np.inf])}, "`time` in .* to rise, without NaN"),
        ({"time": np.array([np.nan]), "velocity": np.zeros((1, 4, 3, 2, 3))}, "`time` in .* to rise, without NaN"),
        ({"x": np.array([0.0, 1.0, 2.0, np.inf])}, "`x` in .* to rise in equal steps"),
        ({"x": np.array([-1e308, 0.0, 1e308, np.inf])}, "`x` in .* to rise in equal steps"),
        ({"x": 1e-300 * np.arange(4)}, "steps of `x` in .* are 1e-300 m: save its places in metres"),
        ({"x": 1e300 * np.arange(4)}, "steps of `x` in .* are 1e[+]300 m"),
        ({"y": np.zeros((3, 1))}, "`y` in .* to be a list of numbers"),
        ({"units": "knots"}, "`velocity` in .* is in 'knots', not in m/s"),
    ],
)
def test_a_grid_that_does_not_fit_is_refused(tmp_path, changes, words):
    with value_error(words):
        read_grid(_npz(tmp_path / "w.npz", **changes))


def test_other_files_and_numbers_are_refused(tmp_path):
    (tmp_path / "w.txt").write_text("wind")
    np.savez(tmp_path / "empty.npz", x=np.zeros(2))
    path, turbsim = _npz(tmp_path / "w.npz"), _bts(tmp_path / "w.bts")[0]
    for kind, name, given, words in (
        (RecordedWind, tmp_path / "w.txt", {}, r"give a \.npz, \.nc or \.bts file"),
        (RecordedWind, tmp_path / "none.npz", {}, "does not exist"),
        (RecordedWind, tmp_path / "empty.npz", {}, "has no array `y`"),
        (FrozenWind, path, {}, "changes over time: use RecordedWind"),
        (RecordedWind, path, {"scale": math.nan}, "`scale` to be finite, but got"),
        (RecordedWind, path, {"start": math.inf}, "`start` to be finite, but got"),
        (FrozenWind, turbsim, {"scale": math.inf}, "`scale` to be finite, but got"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            kind(name, **given)


@pytest.mark.parametrize("engine", ["netCDF4", "scipy.io"])
def test_netcdf(tmp_path, engine, monkeypatch):
    """One variable for each component, with its axes in another order and with units."""
    module = pytest.importorskip(engine)
    t, x, y, z = np.meshgrid(*AXES.values(), indexing="ij")
    velocity = _linear(t, x, y, z)

    def write(path, units):
        if engine == "netCDF4":
            file = module.Dataset(path, "w")
        else:
            monkeypatch.setitem(__import__("sys").modules, "netCDF4", None)
            file = module.netcdf_file(path, "w")
        for name, axis in AXES.items():
            file.createDimension(name, len(axis))
            variable = file.createVariable(name, "f8", (name,))
            variable[:] = axis
            variable.units = "seconds since 2020-01-01" if name == "time" else units
        for number, name in enumerate("uvw"):
            variable = file.createVariable(name, "f8", ("time", "z", "y", "x"))
            variable[:] = velocity[..., number].transpose(0, 3, 2, 1)
            variable.units = "m s-1"
        file.close()
        return path

    found = read_grid(write(tmp_path / "w.nc", "m"))
    np.testing.assert_allclose(found.velocity, velocity, rtol=1e-6)
    np.testing.assert_allclose(found.times, AXES["time"])
    with value_error(r"`x` in .* is in .km., not in m"):
        read_grid(write(tmp_path / "km.nc", "km"))


@pytest.mark.parametrize("content", [b"CDF", b"CDF\x01", b"\x89HDF\r\n\x1a\n"])
def test_without_netcdf4_a_file_that_scipy_cannot_read_names_the_extra(tmp_path, monkeypatch, content):
    monkeypatch.setitem(__import__("sys").modules, "netCDF4", None)
    (tmp_path / "w.nc").write_bytes(content)
    with value_error(r"install gaussian-swaying\[netcdf\]"):
        read_grid(tmp_path / "w.nc")


def test_a_frozen_box(tmp_path):
    axes = {name: step * np.arange(n) for name, n, step in (("x", 16, 2.0), ("y", 8, 3.0), ("z", 4, 4.0))}
    velocity = np.random.default_rng(0).normal(size=(16, 8, 4, 3))
    np.savez(tmp_path / "box.npz", velocity=velocity, **axes)
    wind = WindField([0.0, 5.0, 0.0], effects=[FrozenWind(tmp_path / "box.npz", scale=0.5)])
    middle = 0.5 * 7 * 3.0  # its x axis is our y, its y is our -x
    u, v, w = velocity[4, 2, 3]
    found = wind.at(double(0.0), double([[middle - 2 * 3.0, 4 * 2.0, 3 * 4.0]]))[0]
    np.testing.assert_allclose(found.numpy(), [-0.5 * v, 5 + 0.5 * u, 0.5 * w], atol=1e-5)


def _bts(path, kind=8):
    """A file of TurbSim with 4 times, 3 points across and 2 up."""
    nt, ny, nz = 4, 3, 2
    velocity = np.random.default_rng(0).normal([8.0, 0.0, 0.0], 1.0, (nt, ny, nz, 3))
    slope, shift = np.array([2000.0, 4000.0, 4000.0]), np.array([-16000.0, 10.0, -20.0])
    raw = np.rint(velocity * slope + shift).astype("<i2")
    words = b"made by a test"
    head = struct.pack("<h4i6f", kind, nz, ny, 1, nt, 2.0, 1.0, 0.5, 8.0, 10.0, 9.0)  # dz, dy, dt, speed, hub, bottom
    head += np.stack([slope, shift], 1).astype("<f4").tobytes() + struct.pack("<i", len(words)) + words
    body = b"".join(raw[t].transpose(1, 0, 2).tobytes() + bytes(6) for t in range(nt))
    path.write_bytes(head + body)
    return path, velocity


def test_a_file_of_turbsim(tmp_path):
    path, velocity = _bts(tmp_path / "w.bts")
    found = read_bts(path)
    np.testing.assert_allclose(found.velocity, velocity, atol=0.51 / 2000)
    assert (found.dt, found.speed, found.bottom) == (0.5, 8.0, 9.0)
    assert found.spacing == (1.0, 2.0)


HEADER = {"kind": 7, "nz": 1, "ny": 2, "towers": 0, "nt": 2, "dz": 2.0, "dy": 1.0, "dt": 0.5, "speed": 8.0} | {
    name: 1.0 for name in ("hub", "bottom", "slope_u", "shift_u", "slope_v", "shift_v", "slope_w", "shift_w")
}


BAD_FIELDS = {
    "nz": [0],
    "ny": [1],
    "nt": [1],
    "towers": [-1],
    "letters": [-4],
    **dict.fromkeys(("dz", "dy"), (0.0, -1.0, math.nan, math.inf, 1e-30)),
    **dict.fromkeys(("dt", "speed"), (0.0, -1.0, math.nan, math.inf)),
    "bottom": [math.nan],
    **dict.fromkeys(("slope_u", "slope_v", "slope_w"), (0.0, math.nan, math.inf)),
    "shift_v": [math.nan],
    "more": [2, -2],
}


def test_headers_of_turbsim(tmp_path):
    path = tmp_path / "w.bts"

    def write(more=0, **changes):
        own = HEADER | {"letters": 0} | changes
        values = own["nt"] * (own["ny"] * own["nz"] + own["towers"]) * 3
        size = 2 * values + own["letters"] + more  # may be below zero, as the header is longer
        data = struct.pack("<h4i12fi", *own.values())
        path.write_bytes((data + bytes(max(size, 0)))[: len(data) + size])

    for changes in ({}, {"towers": 3, "letters": 5}):
        write(**changes)
        assert read_bts(path).velocity.shape == (2, 2, 1, 3)
    for name, values in BAD_FIELDS.items():
        for value in values:
            write(**{name: value})
            with value_error("is damaged"):
                read_bts(path)


def test_planes_of_turbsim_pass_one_after_the_other(tmp_path):
    path, velocity = _bts(tmp_path / "w.bts")
    wind = WindField([0.0, -8.0, 0.0], effects=[FrozenWind(path, origin=[1.0, 2.0, 3.0])])
    for time in range(6):
        # one metre to the left of the flow, -y, is +x; 11 m above the ground
        found = wind.at(double(0.5 * time), double([[2.0, 2.0, 14.0]]))[0]
        u, v, w = velocity[time % 4, 2, 1]
        np.testing.assert_allclose(found.numpy(), [v, -u, w], atol=1e-3)


def test_turbsim_checks_its_wind(tmp_path):
    path, _ = _bts(tmp_path / "w.bts")
    with value_error(r"is 8 m/s, but `wind.flow` has 6 m/s: set it to 8 m/s"):
        WindField([6.0, 0.0, 0.0], effects=[FrozenWind(path)])
    with value_error("not a full-field"):
        read_bts(_bts(tmp_path / "bad.bts", kind=3)[0])


def _csv(path, text):
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_an_anemometer(tmp_path):
    path = _csv(tmp_path / "a.csv", "time [s],u [m/s],v (m/s),note,w\n0,1,2,a,1\n\n2.0,3,-2,b,-3\n")
    wind = WindField(schedule=path)
    assert_close(wind(1.0), double([2.0, 0.0, -1.0]))
    assert_close(wind(9.0), double([3.0, -2.0, -3.0]))
    times, flows = read_anemometer(_csv(tmp_path / "b.csv", "Direction [deg],Speed,time\n270,4,0\n360,2,1\n45,1,2\n"))
    assert times == [0.0, 1.0, 2.0]
    root = math.sqrt(0.5)  # from the west, north and north-east
    np.testing.assert_allclose(flows, [[4, 0, 0], [0, -2, 0], [-root, -root, 0]], atol=1e-12)


TOA5 = """"TOA5","6843","CR3000","1","std","program","2","above"
"TIMESTAMP","RECORD","Ux","Uy","Uz","Ts"
"TS","RN","m/s","m/s","m/s","C"
"","","Smp","Smp","Smp","Smp"
"2012-06-07 23:59:59.95",7,1.5,-2,0.25,27
"2012-06-08 00:00:00",8,2.5,-1,-0.5,27.1
"""


def test_a_logger_of_campbell_scientific(tmp_path):
    times, flows = read_anemometer(_csv(tmp_path / "a.dat", TOA5))
    assert times == [0.0, 0.05]  # over midnight
    assert flows == [[1.5, -2.0, 0.25], [2.5, -1.0, -0.5]]


BAD_LINES = {
    TOA5.replace('"2012-06-08 00:00:00"', '"midnight"'): "Line 6 of .* has no time",
    TOA5.replace("2.5,-1", '"NAN",-1'): "Line 6 of .* has no number",
    TOA5.replace('"m/s","m/s","m/s"', '"knots","m/s","m/s"'): r"`u` in .* is in 'knots'",
    "\n".join(TOA5.splitlines()[:3]): "ends within the four lines of its head",
    TOA5.replace("Ux", "wind"): r"has no column `u \[m/s\]`",
    "time,u [km/h],v\n0,1,2\n": r"`u` in .* is in 'km/h', not in m/s",
    "time [ms],u,v\n0,1,2\n": r"`time` in .* is in 'ms', not in s",
    "time,u,v,U [m/s]\n0,1,2,3\n": "has two columns `u`",
    "u,v\n1,2\n": r"has no column `time \[s\]`",
    "time,speed\n1,2\n": r"has no column `direction \[deg\]`",
    "time,u,v\n0,1,2\n1,,2\n": "Line 3 of .* has no number",
    "time,u,v\n0,1,nan\n": "Line 2 of .* has no number",
    "time,u,v\n": "has no measurements",
    "time,u,v\n1,1,1\n0,1,1\n": "times of `schedule` to increase",
}


def test_an_anemometer_that_does_not_fit_is_refused(tmp_path):
    for text, words in BAD_LINES.items():
        with value_error(words):
            WindField(schedule=_csv(tmp_path / "a.csv", text))
