"""Tries the installed wheel with the base dependencies alone: every command, and the sentence for each extra.

Run it away from the checkout, with the Python of an environment that holds the wheel and what it needs, and nothing
else: ``python wheel.py``. It works in the folder in which it is started.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

EXTRAS = [
    "cv2",
    "zstandard",
    "pxr",
    "netCDF4",
    "ray",
    "pyarrow",
    "webdataset",
    "tensorboard",
    "matplotlib",
    "pytest",
]
"""Modules of the extras, and of the tests."""

POLE = {"class_path": "Box", "init_args": {"min": [None, None, None], "max": [0.11, None, None]}}
SMALL = {
    "scene.generator.init_args.spacing": 0.1,
    "solver.dx": 0.2,
    "solver.boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": None, "region": POLE}}],
    "camera.init_args.width": 64,
    "camera.init_args.height": 36,
    "recorder.video": False,
}
"""A flag of 96 Gaussians."""

BRIEF = {
    "trainer.max_steps": 4,
    "trainer.val_check_interval": 4,
    "trainer.enable_progress_bar": False,
    "checkpoint.every_n_train_steps": 4,
    "data.init_args.capture.size": 32,
}
"""A training of four photos."""

PHYSGAUSSIAN = {"material": "jelly", "E": 2e6, "nu": 0.4, "density": 200, "substep_dt": 1e-4, "frame_dt": 0.04}
PHYSGAUSSIAN |= {"frame_num": 125, "g": [0, 0, 0], "grid_v_damping_scale": 0.9999, "n_grid": 50}
PHYSGAUSSIAN |= {"additional_material_params": [], "boundary_conditions": [{"type": "bounding_box"}]}


def words(options: dict[str, Any]) -> list[str]:
    """Options as a command takes them."""
    return [f"--{name}={json.dumps(value)}" for name, value in options.items()]


def call(arguments: str | list[str]) -> tuple[int, str]:
    """Exit code and all that a command prints."""
    from gaussian_swaying.cli.main import main

    given = arguments.split() if isinstance(arguments, str) else arguments
    told, begin = io.StringIO(), time.monotonic()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        try:
            code = main(given)
        except SystemExit as end:  # --help
            code = end.code if isinstance(end.code, int) else 1
    print(f"{time.monotonic() - begin:6.1f} s  gaussian-swaying {' '.join(given)}"[:110], flush=True)
    return code, told.getvalue()


def works(arguments: str | list[str], *files: str) -> None:
    """A command ends well and has written some files."""
    code, told = call(arguments)
    assert code == 0, told
    for name in files:
        assert Path(name).stat().st_size > 0, f"{name} is missing or empty after {arguments}"


def needs(extra: str, arguments: str | list[str]) -> None:
    """A command ends with one sentence that names the extra."""
    code, told = call(arguments)
    assert code == 2, told
    assert told.startswith("error: "), told
    assert told.count("\n") == 1, told
    assert f"gaussian-swaying[{extra}]" in told, told


def write_film(path: Path) -> None:
    """A film of three grey frames of 64 x 36 pixels."""
    import numpy as np

    from gaussian_swaying.recording.video import VideoEncoder

    encoder = VideoEncoder(path, 30)
    for _ in range(3):
        encoder.write(np.full((36, 64, 3), 90, np.uint8))
    encoder.finish()


def main() -> None:
    """All commands; an assertion that fails ends the program."""
    import gaussian_swaying
    from gaussian_swaying.cli.main import COMMANDS

    assert Path(gaussian_swaying.__file__).is_relative_to(sys.prefix), gaussian_swaying.__file__
    found = [name for name in EXTRAS if importlib.util.find_spec(name)]
    assert found == [], f"the environment holds more than the base dependencies: {found}"
    script = "from importlib.metadata import entry_points as e; e(group='console_scripts')['gaussian-swaying'].load()()"
    told = subprocess.run(
        [sys.executable, "-c", script, "--version"], capture_output=True, text=True, check=True
    ).stdout
    assert told == f"gaussian-swaying {gaussian_swaying.__version__}\n", told
    tried = set()
    for command in COMMANDS:
        code, told = call(f"{command} --help")
        assert code == 0, told
        assert "usage: gaussian-swaying" in told, told

    small = ["--config=flag", "--device=cpu", *words(SMALL)]
    works(["sim", *small, "--frames=2", "--output=run"], "run/frames/00001.png", "run/summary.json")
    tried.add("sim")
    works("export --web run", "run/film.html")
    works("eval run run --device cpu --no-video", "run/eval/eval.json")
    tried.add("eval")

    from gaussian_swaying.gaussians.ply import write_ply
    from gaussian_swaying.scenes.procedural import FlagScene

    write_ply(Path("flag.ply"), FlagScene(spacing=0.1).generate())
    works("preview flag.ply --hold=-x --frames=2 --height=96 --device=cpu --output=look", "look/starter.yaml")
    works(
        "sim --config look/starter.yaml --device=cpu --recorder.video=false --output swayed", "swayed/frames/00001.png"
    )
    tried.add("preview")
    works("export flag.ply flag.splat", "flag.splat")
    works("export flag.ply flag.spz", "flag.spz")
    needs("spz", "export flag.spz flag4.spz --spz-version=4")
    needs("usd", "export flag.ply flag.usdc")
    tried.add("export")
    Path("jelly.json").write_text(json.dumps(PHYSGAUSSIAN))
    works("convert jelly.json --output jelly.yaml", "jelly.yaml")
    tried.add("convert")

    plan = {"base": "flag", "settings": SMALL | {"frames": 2}, "axes": {"material.E": [1e4, 2e4]}}
    Path("sweep.yaml").write_text(json.dumps(plan))
    works("sweep sweep.yaml --device=cpu --workers=1 --output=sweep", "sweep/sweep.csv", "sweep/contact_sheet.png")
    needs("parquet", "sweep sweep.yaml --parquet --output=other")
    needs("ray", "sweep sweep.yaml --ray --output=other")
    tried.add("sweep")
    works(["train", "fit", "--config=quick_cpu", *words(BRIEF)], "outputs/train/quick_cpu/point_cloud.ply")
    tried.add("train")
    Path("wind.nc").write_bytes(b"CDF\x01")
    wind = {"class_path": "RecordedWind", "init_args": {"path": "wind.nc"}}
    needs("netcdf", ["sim", *small, f"--wind.effects=[{json.dumps(wind)}]", "--output=other"])
    needs("fit", "fit --config=printed_flag --output=other")
    write_film(Path("film.mp4"))
    needs("fit", "fit film.mp4 --splat flag.ply --length object 1.2 --up +z --output=other")
    code, told = call("fit film.mp4 --output=other")
    assert code == 2, told
    assert "add --splat" in told, told
    tried.add("fit")
    needs("fit", "camera run/frames/00001.png flag.ply --output=other")
    tried.add("camera")
    code, told = call("live --no-browser --port=70000")
    assert code == 2, told
    assert "--port" in told, told
    tried.add("live")
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    works("warm")
    tried.add("warm")
    assert not Path("other").exists()
    assert tried == set(COMMANDS), f"commands that are not tried: {set(COMMANDS) - tried}"


if __name__ == "__main__":  # the processes of a sweep import this file
    main()
