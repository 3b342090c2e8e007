"""Small films of things in wind whose answer is known, for ``gaussian-swaying fit``.

A film is a simulation on a finer grid and with shorter steps than those of the fit, with noise, compressed as H.264,
and seen by one camera. It is easier than a real film: the laws are right, and only the grid is not.
"""

from __future__ import annotations

import copy
import json
import math
import random
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import yaml

from bench.problems.films import opengl
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.scenes.patches import box, to_cloud
from gaussian_swaying.scenes.printed_cloth import printed_colours
from gaussian_swaying.simulation.simulation import Simulation

FPS = 30
SIZE = (320, 240)
NOISE, CRF = 3.0, 28
"""Noise of each pixel and colour [grey levels of 255], and the quality of H.264 that a phone's film has."""
FINER = 2 / 3
"""Cells of the film's grid per those of the fit's."""
GUST = 0.1
"""Time between two speeds of a wind with gusts [s]."""
SPACING = 0.02
"""Distance between the Gaussians of a cloth [m]."""


@dataclass(frozen=True)
class Kind:
    """A thing in wind.

    Attributes:
        size: Width and height of a cloth, or side and height of a post [m].
        held: Edges that are held: letters of ``left``, ``right``, ``top`` and ``foot``.
        speed: Of the wind, in the middle of what is drawn [m/s].
        azimuth: Of the wind [degrees].
        E: Young's modulus [Pa].
        density: [kg/m³].
    """

    size: tuple[float, float]
    held: tuple[str, ...]
    speed: float
    azimuth: float
    E: float
    density: float = 25.0


KINDS = {
    "curtain": Kind((0.6, 0.6), ("top",), 2.5, 65.0, 4e3),
    "banner": Kind((0.6, 0.4), ("left", "right"), 3.5, 70.0, 6e3),
    "pole flag": Kind((0.6, 0.4), ("left",), 4.0, 40.0, 8e3),
    "post": Kind((0.12, 0.42), ("foot",), 3.5, 60.0, 6e3, 60.0),
}


@dataclass(frozen=True)
class Film:
    """One film and its answer.

    Attributes:
        kind: A name of :data:`KINDS`.
        speed: Of the wind [m/s].
        azimuth: Of the wind, from +x towards +y [degrees].
        E: Young's modulus [Pa].
        seconds: Its length.
        start: Time at which the motion begins [s]; below 0, the film begins in motion.
        ramp: The speed at the end per that at the begin; 1 for a steady wind.
        gusts: Standard deviation of the speed per its mean, and the time scale of its changes [s]; None for none.
        seed: Of the noise.
    """

    kind: str
    speed: float
    azimuth: float
    E: float
    seconds: float = 1.5
    start: float = 0.0
    ramp: float = 1.0
    gusts: tuple[float, float] | None = None
    seed: int = 0

    @property
    def steady(self) -> bool:
        """True in a wind that does not change."""
        return self.ramp == 1 and self.gusts is None

    @property
    def truth(self) -> dict[str, float]:
        """The values that a fit is to find."""
        return {"wind.speed": self.speed, "wind.azimuth": self.azimuth, "material.E": self.E}

    def unknowns(self, off: float = 1.0) -> dict[str, Any]:
        """Unknowns of a fit; with ``off``, start values so many times off, and 60 degrees."""
        kind = KINDS[self.kind]
        side = 1 if self.seed % 2 else -1
        ranges = {
            "wind.speed": [kind.speed / 5, 4 * kind.speed],
            "wind.azimuth": [kind.azimuth - 100, kind.azimuth + 100],
            "material.E": [kind.E / 8, 8 * kind.E],
        }
        if off == 1:
            return {name: {"range": ends} for name, ends in ranges.items()}
        begin = {"wind.speed": self.speed * off**side, "wind.azimuth": self.azimuth + 60 * side}
        begin["material.E"] = self.E * off**-side
        return {n: {"range": ends, "start": min(max(begin[n], ends[0]), ends[1])} for n, ends in ranges.items()}


def drawn(kind: str, number: int, **changes: Any) -> Film:
    """The film of a number: speed, azimuth and E are drawn around those of the kind."""
    own, draw = KINDS[kind], random.Random(f"{kind} {number}")
    speed = own.speed * 1.25 ** draw.uniform(-1, 1)
    azimuth = own.azimuth + draw.uniform(-20, 20)
    return Film(kind, speed, azimuth, own.E * 1.5 ** draw.uniform(-1, 1), seed=number, **changes)


def settings_of(film: Film, folder: Path, finer: float = 1.0) -> dict[str, Any]:
    """The configuration of ``sim`` on the grid of the fit, or on one of cells ``finer`` times as large.

    The splat of a post is written into ``folder``.
    """
    kind = KINDS[film.kind]
    width, height = kind.size
    edge = 0.6 * SPACING
    ends: dict[str, tuple[list[float | None], list[float | None]]] = {
        "left": ([None] * 3, [edge, None, None]),
        "right": ([width - edge, None, None], [None] * 3),
        "top": ([None, None, height - edge], [None] * 3),
        "foot": ([None] * 3, [None, None, 0.04]),
    }
    pins = [
        {
            "class_path": "PinnedRegion",
            "init_args": {
                "kind": "nodes" if name == "foot" else None,
                "region": {"class_path": "Box", "init_args": {"min": ends[name][0], "max": ends[name][1]}},
            },
        }
        for name in kind.held
    ]
    soft = "foot" in kind.held
    middle = [0.0 if soft else 0.5 * width, 0.0, 0.45 * height]
    reach = 1.9 * height if soft else 2.0 * max(width, height)
    scene: dict[str, Any] = {"metres_per_unit": 1.0}
    if soft:
        write_ply(folder / "post.ply", _post(width, height))
        scene |= {"ply": str(folder / "post.ply"), "filling": {"spacing": 0.02}}
    else:
        init = {"width": width, "height": height, "spacing": SPACING, "ripple": 0.005, "pattern": "printed"}
        scene["generator"] = {"class_path": "FlagScene", "init_args": init}
    material = {"E": film.E, "nu": 0.3, "density": kind.density}
    return {
        "frame_dt": 1 / FPS,
        "background": [0.46, 0.58, 0.72],
        "scene": scene,
        "material": material | ({"law": "NeoHookean"} if soft else {"thickness": 0.01}),
        "solver": {"dx": (0.048 if soft else 0.06) * finer, "cfl": 0.4 * finer, "boundaries": pins},
        "wind": {"flow": [film.speed, 0.0, 0.0]} if film.steady else {"schedule": _schedule(film)},
        "aero": {"C_D": 1.0, "C_F": 0.0, "C_L": 0.0, "law": "projected"},
        "cameras": {
            "phone": {
                "class_path": "LookAtCamera",
                "init_args": {
                    "eye": [middle[0] - 0.45 * reach, -0.9 * reach, middle[2] + 0.2 * reach],
                    "target": middle,
                    "fov_y": 40.0,
                    "width": SIZE[0],
                    "height": SIZE[1],
                },
            }
        },
    }


def make(film: Film, folder: Path) -> None:
    """Write ``film.mp4`` with its ``transforms.json``, ``base.yaml`` with a wind of its own, and ``truth.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    own = copy.deepcopy(settings_of(film, folder, FINER))
    if film.steady:
        turn = math.radians(film.azimuth)
        own["wind"]["flow"] = [film.speed * math.cos(turn), film.speed * math.sin(turn), 0.0]
    simulation = _read(own, folder / "film.yaml")
    count = round(film.seconds * FPS)
    still, cut = max(0, round(film.start * FPS)), max(0, round(-film.start * FPS))
    camera = simulation.painter.camera_at(0, "phone")
    pictures = []
    for frame in simulation.frames(count - still + cut):
        if frame.index >= cut:
            pictures.append(_picture(simulation, frame.state, camera))
    pictures = [pictures[0]] * still + pictures
    _write_mp4(folder / "film.mp4", pictures, film.seed)
    focal, view = camera.intrinsics, opengl(camera).tolist()
    entry = {"video_path": "film.mp4", "camera": "phone", "fps": FPS, "transform_matrix": view}
    lens = {"fl_x": float(focal[0, 0]), "fl_y": float(focal[1, 1]), "cx": float(focal[0, 2]), "cy": float(focal[1, 2])}
    fields = lens | {"w": camera.width, "h": camera.height, "frames": [entry]}
    (folder / "transforms.json").write_text(json.dumps(fields), encoding="utf-8")
    kind = KINDS[film.kind]
    base = settings_of(replace(film, E=kind.E, speed=kind.speed, ramp=1.0, gusts=None), folder)
    (folder / "base.yaml").write_text(yaml.safe_dump(base), encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps(film.truth), encoding="utf-8")


def speeds(film: Film) -> list[tuple[float, float]]:
    """Times [s] and speeds [m/s] of a wind that rises from the first frame to the last, or has gusts."""
    if film.gusts is None:
        return [(0.0, film.speed), (film.seconds, film.ramp * film.speed)]
    intensity, scale = film.gusts
    draw, now, found = random.Random(f"gusts {film.kind} {film.seed}"), 0.0, []
    keep = math.exp(-GUST / scale)
    for k in range(math.ceil(film.seconds / GUST) + 1):
        now = keep * now + math.sqrt(1 - keep**2) * draw.gauss(0, 1) if k else draw.gauss(0, 1)
        found.append((GUST * k, film.speed * max(0.1, 1 + intensity * now)))
    return found


def _schedule(film: Film) -> list[dict[str, Any]]:
    turn = math.radians(film.azimuth)
    return [
        {"time": time, "flow": [speed * math.cos(turn), speed * math.sin(turn), 0.0]} for time, speed in speeds(film)
    ]


def _read(settings: dict[str, Any], path: Path) -> Simulation:
    if "schedule" in settings["wind"]:
        settings["wind"]["interpolation"] = "linear"
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return Simulation.from_yaml(path, device="cpu")


def _post(side: float, height: float, spacing: float = 0.01):  # type: ignore[no-untyped-def]
    """A post of printed foam as flat Gaussians on its skin."""
    half = 0.5 * side
    patches = box([-half, -half, 0.0], [half, half, height], spacing)
    place = patches.center
    print_ = printed_colours(4 * (place[:, 0] + 1.7 * place[:, 1] + half), 4 * place[:, 2])
    return to_cloud(patches.painted(print_), overlap=0.5, ambient=1.0)


def _picture(simulation: Simulation, state: Any, camera: Camera) -> torch.Tensor:
    painter = simulation.painter
    gaussians = painter.deformed(state)
    return painter.draw(gaussians, painter.colors(gaussians, camera), camera).color.clamp(0, 1)


def _write_mp4(path: Path, pictures: list[torch.Tensor], seed: int) -> None:
    from imageio_ffmpeg import write_frames

    generator = torch.Generator().manual_seed(seed)
    options = {
        "fps": FPS,
        "codec": "libx264",
        "quality": None,
        "output_params": ["-crf", str(CRF)],
        "macro_block_size": 2,
    }
    film = write_frames(str(path), SIZE, **options)
    film.send(None)
    for picture in pictures:
        noisy = 255 * picture.cpu() + NOISE * torch.randn(picture.shape, generator=generator)
        film.send(noisy.round().clamp(0, 255).to(torch.uint8).numpy().tobytes())
    film.close()
