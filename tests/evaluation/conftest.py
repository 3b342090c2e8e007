"""Folders of a run and of a reference, as small as the metrics allow."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

WIDTH, HEIGHT = 24, 16
ORIGIN = (1.0, 2.0, 3.0)
"""Where the scene has the origin of the simulation [scene units]."""


def picture(frame):
    pixels = np.random.default_rng(0).integers(0, 40, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    pixels[4:9, 2 + frame : 7 + frame] = 220
    return pixels


def sheet(frame, cells=8):
    """Vertices (V, 3) [m] and triangles of a sheet of 2 m by 1 m that rises by 0.1 m a frame."""
    u, v = np.meshgrid(np.linspace(0, 2, 2 * cells + 1), np.linspace(0, 1, cells + 1), indexing="ij")
    vertices = np.stack([u.ravel(), np.full(u.size, 0.1 * frame), v.ravel()], -1)
    i = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def write_pictures(folder, pixels, start=0):
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(pixels, start):
        iio.imwrite(folder / "frames" / f"{number:05d}.png", image)


@pytest.fixture
def make_run(tmp_path):
    """A run of some frames; its particles lie on the sheet, ``above`` it by so much [m]."""

    def _make(name="run", frames=4, above=0.0, change=0, scale=1.0, particles=3000, **summary):
        folder = tmp_path / name
        write_pictures(folder, [picture(i) + np.uint8(change) for i in range(frames)])
        draw = np.random.default_rng(1).random((particles, 2)) * [2, 1]
        arrays = {}
        for i in range(frames):
            at = np.stack([draw[:, 0], np.full(particles, 0.1 * i + above), draw[:, 1]], -1)  # [m], axes of the scene
            arrays[f"position_{i:05d}"] = (at - scale * np.array(ORIGIN)).astype(np.float32)
            arrays[f"F_{i:05d}"] = np.tile(np.eye(3, dtype=np.float16), (particles, 1, 1))
        np.savez(folder / "trajectory.npz", **arrays)
        place = {"origin": list(ORIGIN), "rotation": np.eye(3).tolist(), "metres_per_unit": scale}
        told = {"status": "complete", "sim_frame": place, "frame_dt_s": 0.04, "frames": frames} | summary
        (folder / "summary.json").write_text(json.dumps(told))
        return folder

    return _make


@pytest.fixture
def make_reference(tmp_path):
    def _make(name="reference", frames=4, before=0, start=1, cloth=True, pictures=True, **arrays):
        folder = tmp_path / name
        folder.mkdir()
        numbers = range(-before, frames)
        if pictures:
            write_pictures(folder, [picture(max(i, 0)) if i >= 0 else 255 - picture(0) for i in numbers], start)
        if cloth:
            positions = np.stack([sheet(i)[0] if i >= 0 else sheet(50)[0] for i in numbers])
            np.savez(folder / "cloth.npz", **({"positions": positions, "faces": sheet(0)[1]} | arrays))
        return folder

    return _make
