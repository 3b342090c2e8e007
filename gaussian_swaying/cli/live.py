"""``gaussian-swaying live``: a page on which the wind can be changed while a scene moves."""

from __future__ import annotations

import argparse
import time
import webbrowser
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import run_command
from gaussian_swaying.cli.scene import is_given, settings_of, words_of
from gaussian_swaying.player.server import Server
from gaussian_swaying.player.session import Session, in_real_time, share_cores
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


def build_options() -> argparse.ArgumentParser:
    """The parser of the options that are not those of ``gaussian-swaying sim``."""
    parser = argparse.ArgumentParser(
        prog=program.name("live"),
        allow_abbrev=False,
        usage=f"{program.name('live')} [SCENE] [options]",
        description="Open a page on which the wind can be changed while a scene moves. SCENE is a splat, a "
        "configuration (.yaml), the name of a shipped one, or the folder of a run; without it, a flag. Further options "
        "are those of `gaussian-swaying sim`, for example --solver.dx 0.04.",
    )
    add = parser.add_argument
    add("--host", default="127.0.0.1", help="address to listen on; 0.0.0.0 lets other computers in (default: this one)")
    host = "a further name or address by which other computers open the page; can be given several times"
    add("--allow-host", action="append", default=[], metavar="NAME", help=host)
    add("--port", type=int, default=8080, help="port of the page; the next free one if it is taken")
    grid = "real-time: the finest that a short trial simulates in real time (default); configured: as it is"
    add("--grid", default="real-time", choices=("real-time", "configured"), help=grid)
    add("--pixels", type=int, default=1920, help="most pixels of the longer side of a picture")
    add("--no-browser", action="store_true", help="only print the address")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Serve the page until Ctrl-C; 2 on bad input."""
    return run_command(
        lambda: _live(arguments),
        memory="a smaller `scene.region`, a coarser `solver.dx` or fewer `--pixels`",
        expected=(ImportError,),
        arguments=arguments,
    )


def split(parser: ArgumentParser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """The options of this command with the scene, and those of ``gaussian-swaying sim``, in any order."""
    options, rest = build_options().parse_known_args(arguments)
    scenes, further = words_of(parser, rest)
    if len(scenes) > 1:
        raise ValueError(f"Expected one SCENE, but got {' and '.join(scenes)}: give one of them.")
    if not 16 <= options.pixels <= 8192:
        raise ValueError(f"Expected `--pixels` from 16 to 8192, but got {options.pixels}.")
    options.scene = scenes[0] if scenes else None
    return options, further


def session_of(parser: ArgumentParser, settings: Namespace, real_time: bool) -> Session:
    """A session of a scene, not started yet."""
    if settings.copies:
        raise ValueError("The live page shows one object: leave out `copies`, or record them with `sim`.")
    simulation = Simulation.from_settings(parser, settings)
    if simulation.device.type == "cpu":
        share_cores()
    by_modes = settings.custom_solver is None and settings.solver.formulation == "modes"
    if by_modes:  # their stiffness is that of the configured grid, on which they are in real time
        print("The configured grid is kept, as the modes have their frequencies on it.", flush=True)
    if by_modes or not real_time or settings.custom_solver is not None:
        return Session(parser, settings, simulation)
    choice = in_real_time(parser, settings, simulation)
    print(choice.sentence, flush=True)
    session = Session(parser, choice.settings, choice.simulation)
    session.configured_dx = float(settings.solver.dx)
    return session


def _live(arguments: Sequence[str]) -> None:
    parser = Simulation.parser()
    options, further = split(parser, arguments)
    page = Server(options.host, options.port, options.pixels, options.allow_host)
    session = None
    try:
        print(f"The wind blows at {page.url} (Ctrl-C ends it).", flush=True)
        if page.url_elsewhere is not None:
            print(f"Other computers open {page.url_elsewhere}; whoever has the link can change the scene.", flush=True)
        if not options.no_browser:
            webbrowser.open(page.url)
        settings = settings_of(parser, options.scene, further, page.scratch, page.progress)
        page.progress(0.8, "Making the simulation")
        session = session_of(parser, settings, options.grid == "real-time" and not is_given(further, "--solver.dx"))
        page.show(session)
        session.start()
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        print("Ended.")
    finally:
        page.close()
        if session is not None:
            session.close()
