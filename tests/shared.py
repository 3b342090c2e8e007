"""What tests of several rooms share: draws, material, a small flag, the files of a folder, how a command refuses."""

import csv
import math
import struct
import warnings
import zlib
from contextlib import contextmanager

import pytest
import torch
from torch.testing import assert_close

from gaussian_swaying import Box, MaterialPoints
from gaussian_swaying.config.parser import option
from gaussian_swaying.geometry.regions import Region

POLE = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.11, None, None]}}
PIN = {"class_path": "PinnedRegion", "init_args": {"region": POLE}}
ZERO = (0, 0, 0)
in_both = pytest.mark.parametrize("formulation", ["total", "updated"])
SMALL = {
    "scene.generator.init_args.spacing": 0.1,
    "scene.generator.init_args.overlap": 0.6,
    "contact": None,
    "solver.dx": 0.2,
    "solver.boundaries": [PIN],
    "camera.init_args.width": 32,
    "camera.init_args.height": 18,
}
"""Settings that make the shipped flag a small one."""


def words(settings):
    return [option(name, value) for name, value in settings.items()]


def advanced(simulation, frames, state=None):
    state, log = simulation.start() if state is None else state, []
    for _ in range(frames):
        state, health = simulation.advance(state)
        log.append(health)
    return state, log


@contextmanager
def without_waits():
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def waits(work):
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            work()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in told)


def solid(position, volume, density=100.0, E=1e4, nu=0.3, **more):
    return MaterialPoints.create(position, volume=volume, density=density, youngs_modulus=E, poisson_ratio=nu, **more)


def up_to(x=None, y=None, z=None):
    """The places up to a limit along an axis."""
    return Box([None] * 3, [x, y, z])


def beyond(x=None, y=None, z=None):
    """The places from a limit along an axis on."""
    return Box([x, y, z], [None] * 3)


class Chosen(Region):
    """Points by their number."""

    def __init__(self, mask):
        super().__init__()
        self.mask = mask

    def contains(self, points):
        return self.mask.to(points.device)


EYE = torch.eye(3, dtype=torch.float64)


def double(values):
    """Numbers as a tensor of float64."""
    return torch.tensor(values, dtype=torch.float64)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def rand(*shape, **options):
    """Evenly distributed random numbers, in float64 unless told otherwise."""
    return torch.rand(*shape, **{"dtype": torch.float64} | options)


def randn(*shape, **options):
    """Normally distributed random numbers, in float64 unless told otherwise."""
    return torch.randn(*shape, **{"dtype": torch.float64} | options)


def unit(*shape, **options):
    """Random unit vectors or quaternions, in float64 unless told otherwise."""
    return normalized(randn(*shape, **options))


def gradients(count, device="cpu", dtype=torch.float64):
    f = EYE + 0.3 * randn(count, 3, 3)
    f = f[torch.linalg.det(f).abs() > 0.2]
    assert len(f) > 4
    f[0] = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    return f.to(device, dtype)


def merged(settings, changes):
    both = dict(settings)
    for name, value in changes.items():
        inner = isinstance(value, dict) and "class_path" not in value and isinstance(both.get(name), dict)
        both[name] = merged(both[name], value) if inner else value
    return both


def contents(folder):
    """The bytes of each file of a folder, None for what is none."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refused(main, arguments, capsys, *words, folder=None):
    """The one sentence, which has the words, with which a command ends with code 2; nothing in a folder changes."""
    capsys.readouterr()
    before = folder and contents(folder)
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert (code, error.count("\n")) == (2, 1), error
    assert error.startswith("error: ")
    assert "Traceback" not in error
    for word in words:
        assert word in error, error
    assert (folder and contents(folder)) == before
    return error


def normalized(vectors):
    return torch.nn.functional.normalize(vectors, dim=-1)


def peak(values):
    return values.abs().max()


def longest(vectors):
    return vectors.norm(dim=-1).max()


def value_error(match):
    """Expect a ValueError whose message matches."""
    return pytest.raises(ValueError, match=match)


def user_warning(match):
    """Expect a UserWarning whose message matches."""
    return pytest.warns(UserWarning, match=match)


@contextmanager
def silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def alike(found, expected, share):
    assert_close(found, expected, rtol=share, atol=0)


def near(found, expected, within):
    assert_close(found, expected, rtol=0, atol=within)


def png(width, height, pixels=b""):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


def turned_by(degrees):
    """The rotation about z, float64."""
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return double([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class Means(torch.nn.Module):
    """A network in place of I3D: the mean of each channel and frame."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean(dim=[3, 4]).flatten(1)


def small_network(path):
    """Such a network as TorchScript at a path, which is returned."""
    torch.jit.script(Means()).save(str(path))
    return path
