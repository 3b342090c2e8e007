"""Sixty small films by our own solver on finer cells: does a fit find wind and stiffness, and is its error right?

A camera of 240 x 180 on a tripod, noise, H.264; the first of one and a half seconds is fitted, from starts three times
and 60 degrees off. The films and fits are kept in ``outputs/small_films``.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from bench.problems.films import opengl
from bench.runner import ROOT, Row, study
from gaussian_swaying.cli.fit import main
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.simulation import Simulation

sys.path.append(str(ROOT / "tools" / "datasets"))
from fit_video import write_h264
from soft_case import SoftPattern, splat

FILMS, FPS, FRAMES, UNTIL, FINER = ROOT / "outputs" / "small_films", 24, 36, 1.0, 1.5
OFF, TURNED, NOISE = 3.0, 60.0, 2.0
KINDS: dict[str, dict[str, Any]] = {
    "banner": {"size": (0.6, 0.4), "E": (4e3, 3e4), "azimuth": (30.0, 120.0), "held": ("left", "right")},
    "pole_flag": {"size": (0.6, 0.4), "E": (4e3, 3e4), "azimuth": (10.0, 80.0), "held": ("left",)},
    "curtain": {"size": (0.4, 0.5), "E": (4e3, 3e4), "azimuth": (30.0, 120.0), "held": ("top",)},
    "post": {"size": (0.06, 0.3), "E": (2e4, 1e5), "azimuth": (-30.0, 80.0), "held": ("foot",)},
}
RANGES = {"wind.speed": (0.5, 16.0), "wind.azimuth": (-80.0, 200.0), "material.E": (1e3, 1e5)}


def truth_of(kind: str, number: int) -> dict[str, float]:
    """The true values: speed [m/s], azimuth [degrees] and E [Pa]."""
    draw, own = np.random.default_rng([sorted(KINDS).index(kind), number]), KINDS[kind]
    speed, azimuth, log = draw.uniform(2.0, 5.0), draw.uniform(*own["azimuth"]), draw.uniform(*np.log(own["E"]))
    return {"wind.speed": speed, "wind.azimuth": azimuth, "material.E": math.exp(log)}


def settings(kind: str, cells: float, truth: dict[str, float], ply: Path) -> dict[str, Any]:
    """A configuration of ``sim`` on cells of this size [m]."""
    (width, height), post = KINDS[kind]["size"], kind == "post"
    turn = math.radians(truth["wind.azimuth"])
    boxes = {
        "left": ([None] * 3, [0.02, None, None]),
        "right": ([width - 0.02, None, None], [None] * 3),
        "top": ([None, None, height - 0.02], [None] * 3),
        "foot": ([None] * 3, [None, None, 0.03]),
    }
    pins = [
        {"class_path": "Box", "init_args": dict(zip(("min", "max"), boxes[end], strict=True))}
        for end in KINDS[kind]["held"]
    ]
    filled = {"filling": {"spacing": 0.005}} if post else {}
    material = {"E": truth["material.E"], "nu": 0.3, "density": 60.0 if post else 25.0}
    return {
        "frames": FRAMES,
        "frame_dt": 1 / FPS,
        "scene": {"ply": str(ply), "metres_per_unit": 1.0, "area": "coverage", **filled},
        "material": material | ({} if post else {"thickness": 0.01}),
        "solver": {
            "dx": cells,
            "damping": 0.5,
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": None, "region": pin}} for pin in pins],
        },
        "wind": {"flow": [truth["wind.speed"] * math.cos(turn), truth["wind.speed"] * math.sin(turn), 0.0]},
        "aero": {"C_D": 1.0, "C_F": 0.0, "C_L": 0.0, "law": "projected"}
        if post
        else {"C_D": 0.1, "C_F": 0.3, "C_L": 0.0},
    }


def camera_of(kind: str) -> Camera:
    """In front of the thing, and a little to its side and above."""
    width, height = KINDS[kind]["size"]
    middle, far = np.array([0.0 if kind == "post" else 0.5 * width, 0.05, 0.4 * height]), 2.3 * max(width, height)
    eye = middle + far * np.array([-0.3, -0.9, 0.25])
    return look_at_camera(tuple(eye), tuple(middle), (0, 0, 1), 38.0, 240, 180, dtype=torch.float64)


def write_case(kind: str, number: int, folder: Path) -> dict[str, float]:
    """Write the film of a case and what a fit needs; returns the true values."""
    folder.mkdir(parents=True, exist_ok=True)
    (width, height), truth, cells, ply = (
        KINDS[kind]["size"],
        truth_of(kind, number),
        0.02 if kind == "post" else 0.06,
        folder / "splat.ply",
    )
    sheet = FlagScene(width=width, height=height, spacing=0.015, ripple=0.005, pattern="printed")
    write_ply(ply, splat(SoftPattern(), 0.005) if kind == "post" else sheet.generate())
    (folder / "fine.yaml").write_text(yaml.safe_dump(settings(kind, cells / FINER, truth, ply)))
    simulation, camera = Simulation.from_yaml(folder / "fine.yaml", device="cpu"), camera_of(kind)
    draw, painter = np.random.default_rng(number), simulation.painter

    def pictures():  # type: ignore[no-untyped-def]
        for frame in simulation.frames(FRAMES):
            colour = painter.picture(painter.deformed(frame.state), camera.to(painter.device, torch.float32)).color
            noisy = 255 * colour.cpu().numpy() + NOISE * draw.standard_normal(colour.shape)
            yield noisy.round().clip(0, 255).astype(np.uint8)

    write_h264(folder / "film.mp4", pictures(), (camera.width, camera.height), FPS)
    lens = {name: float(camera.intrinsics[at]) for name, at in
            {"fl_x": (0, 0), "fl_y": (1, 1), "cx": (0, 2), "cy": (1, 2)}.items()}  # fmt: skip
    entry = {"video_path": "film.mp4", "time": 0.0, "transform_matrix": opengl(camera).tolist()}
    (folder / "transforms.json").write_text(
        json.dumps(lens | {"w": camera.width, "h": camera.height, "frames": [entry]})
    )
    way = -1 if number % 2 else 1
    starts = {"wind.speed": truth["wind.speed"] * OFF**-way, "wind.azimuth": truth["wind.azimuth"] - way * TURNED}
    starts["material.E"] = truth["material.E"] * OFF**way
    (folder / "scene.yaml").write_text(yaml.safe_dump(settings(kind, cells, truth | starts, ply)))
    unknowns = {
        name: {"range": list(ends), "start": min(max(starts[name], ends[0]), ends[1])} for name, ends in RANGES.items()
    }
    fit = {"base": ["scene.yaml"], "videos": ["."], "unknowns": unknowns, "until": UNTIL, "search": 16, "tracks": 200}
    (folder / "fit.yaml").write_text(yaml.safe_dump(fit))
    return truth


@study("small_films", [{"kind": kind, "number": number} for number in range(15) for kind in KINDS])
def small_films(kind: str, number: int) -> Row:
    """How far each value is off (azimuth in degrees, others as a share), in standard errors too, and the verdict."""
    folder = FILMS / f"{kind}_{number:02d}"
    truth = write_case(kind, number, folder)
    begin = time.process_time()
    main(["--config", str(folder / "fit.yaml"), "--output", str(folder / "result"), "--device", "cpu"])
    result = json.loads((folder / "result" / "result.json").read_text())
    off = {row["name"]: (row["value"] - truth[row["name"]], row["standard_error"]) for row in result["values"]}
    errors = {name: miss if name == "wind.azimuth" else miss / truth[name] for name, (miss, _) in off.items()}
    return {
        "truth": truth,
        "errors": errors,
        "deviations": {name: miss / error for name, (miss, error) in off.items()},
        "verdict": result["verdict"],
        "processor_s": time.process_time() - begin,
    }
