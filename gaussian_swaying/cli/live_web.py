"""``gaussian-swaying export --live-web``: a page without a server, on which a visitor turns the wind."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying._files import check_page
from gaussian_swaying.cli.scene import settings_of, words_of
from gaussian_swaying.config.parser import scene_name
from gaussian_swaying.player.live_web.budget import TARGETS, fitted
from gaussian_swaying.player.live_web.page import write_live_web
from gaussian_swaying.simulation.simulation import Simulation


def build_options() -> argparse.ArgumentParser:
    """The parser of the options that are not those of ``gaussian-swaying sim``."""
    parser = argparse.ArgumentParser(
        prog=program.name("export"),
        allow_abbrev=False,
        usage=f"{program.name('export')} --live-web SCENE [FILE] [options]",
        description="Write a scene as one .html file that simulates it in a browser, without a server. SCENE is a "
        "configuration (.yaml) or its name, the folder of a run, or a splat; FILE ends in .html. Further options are "
        "those of `gaussian-swaying sim`, for example --solver.dx 0.04.",
    )
    parser.add_argument("--live-web", action="store_true", help="write this page")
    parser.add_argument(
        "--target",
        choices=tuple(TARGETS),
        help="fit the points and the grid to this kind of machine; without it they are those of the configuration",
    )
    return parser


def export_live_web(arguments: Sequence[str]) -> None:
    """Write the page that a command line asks for, and report its size."""
    options, rest = build_options().parse_known_args(arguments)
    parser = Simulation.parser()
    words, further = words_of(parser, rest)
    if not 1 <= len(words) <= 2:
        raise ValueError(f"Expected a SCENE, and perhaps a FILE that ends in .html, but got {words or 'neither'}.")
    scene, target = words[0], default_target(words[0]) if len(words) == 1 else Path(words[1])
    check_page(target, "page")
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_of(parser, scene, further, Path(folder))
        settings.device = "cpu"
        if options.target is None:
            simulation = Simulation.from_settings(parser, settings)
        else:
            simulation, sentence = fitted(parser, settings, options.target)
            print(sentence)
    film = write_live_web(simulation, scene_name(settings), target)
    for note in film.notes:
        print(f"note: {note.replace('the film', 'the page')}")
    print(f"{film.head['count']:,} Gaussians, {simulation.model.points.count:,} material points")
    print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")


def default_target(scene: str) -> Path:
    """The file of a page, if none is given: ``live.html`` in the folder of a run, else the name of the scene."""
    path = Path(scene)
    return path / "live.html" if path.is_dir() else Path(f"{path.stem}.html")
