"""Compile what the first runs on a GPU would compile: ``gaussian-swaying warm``."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gaussian_swaying import _program as program
from gaussian_swaying.cli import shipped
from gaussian_swaying.cli.errors import run_command

FRAMES = 3  # the second records CUDA graphs, and the third replays them


def main(arguments: Sequence[str]) -> int:
    """Compile the kernels of some configurations; 2 on bad input."""
    parser = argparse.ArgumentParser(
        prog=program.name("warm"),
        description="Compile the kernels of the renderer and of some scenes, so that later runs start faster. They are "
        "kept in the caches that are printed at the end. On a CPU nothing is compiled.",
    )
    parser.add_argument(
        "config",
        nargs="*",
        help="YAML files or names of shipped configurations of `sim`; by default all that need no splat",
    )
    return run_command(
        lambda: warm(parser.parse_args(arguments).config),
        stopped="Stopped; what was compiled is kept.",
        memory="fewer configurations",
    )


def warm(configs: Sequence[str]) -> None:
    """Run a few frames of each configuration on the GPU, and print where the compiled kernels are.

    Args:
        configs: Files or names of shipped configurations; if empty, all that need no splat.
    """
    from gaussian_swaying.simulation.simulation import Simulation

    chosen = [shipped.with_shipped(["--config", config], "sim")[1] for config in configs or without_splat()]
    if not torch.cuda.is_available():
        print("torch finds no CUDA device, and on a CPU nothing is compiled.")
        return
    for config in chosen:
        begin = time.perf_counter()
        simulation = Simulation.from_yaml(config, device="cuda")
        with torch.inference_mode():
            for frame in simulation.frames(FRAMES):
                simulation.painter.render(frame.state, frame.index)
        torch.cuda.synchronize()
        print(f"{Path(config).stem}: {time.perf_counter() - begin:.1f} s", flush=True)
    for what, folder in caches().items():
        print(f"{what}: {folder}")


def without_splat() -> list[str]:
    """Names of the shipped configurations whose scene is made in code."""
    root = shipped.folder()
    names = shipped.names("sim")
    return [
        name
        for name in names
        if root is not None and "generator:" in (root / "sim" / f"{name}.yaml").read_text("utf-8")
    ]


def caches() -> dict[str, Path]:
    """Return the cache folders of compiled kernels, of Triton and of gsplat."""
    from gaussian_swaying.rendering.gsplat_renderer import build_folder

    triton = os.environ.get("TRITON_CACHE_DIR") or Path.home() / ".triton" / "cache"
    return {"Triton's kernels": Path(triton), "gsplat's kernels": build_folder()}
