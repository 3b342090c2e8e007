"""Films and pages for a browser: how long a film takes to make, how large it is, and how fast a page simulates."""

from __future__ import annotations

import json
import statistics
import subprocess
import tempfile
from pathlib import Path

from bench.runner import ROOT, Row, study
from bench.speed.timing import seconds
from gaussian_swaying.player.film.page import write_film
from gaussian_swaying.player.live_web.block import pack_solver
from gaussian_swaying.player.live_web.page import PAGE, write_live_web
from gaussian_swaying.simulation.simulation import Simulation


@study("pages", [{"config": "flag", "frames": 75}])
def pages(config: str, frames: int, device: str) -> Row:
    """A run of a configuration, its film as a page and as a bundle, and the page that simulates it."""
    with tempfile.TemporaryDirectory() as name:
        folder, path = Path(name), ROOT / "configs" / "sim" / f"{config}.yaml"
        simulation = Simulation.from_yaml(path, device=device)
        run = seconds(lambda: simulation.run(folder / "run", frames, progress=False), "cpu")
        made = seconds(lambda: write_film(folder / "run", folder / "film.html"), "cpu")
        head = write_film(folder / "run", folder / "film.sway").head
        simulated = Simulation.from_yaml(path, device="cpu", contact=None)
        write_live_web(simulated, config, folder / "page.html")
        sizes = {
            kind: (folder / file).stat().st_size
            for kind, file in (("bytes", "film.html"), ("bundle_bytes", "film.sway"), ("page_bytes", "page.html"))
        }
        numbers = {name: head[name] for name in ("count", "nodes")} | {"error_of_size": head["error"] * head["metre"]}
        told = {"points": simulated.model.points.count, "real_time": in_node(simulated, folder, hurried=False)}
        told["real_time_longest"] = in_node(simulated, folder, hurried=True)
        return {"run_s": run, "film_s": made} | sizes | numbers | told


def in_node(simulation: Simulation, folder: Path, hurried: bool) -> float:
    """Simulated seconds in a second of CPU time of the page's solver in Node.js, the median of three."""
    nodes = simulation.scene.follow.nodes(simulation.start())
    assert nodes is not None
    (folder / "block").write_bytes(pack_solver(simulation, nodes))
    frames = {"kind": "frames", "count": 50, "hurried": hurried}
    words = ["node", ROOT / "tools/player/live_web/run.js", PAGE / "worker.min.js", folder / "block", folder / "state"]
    done = subprocess.run([*words, json.dumps([frames] * 4)], capture_output=True, text=True, check=True)
    return statistics.median(told["simulated"] / told["cpu"] for told in json.loads(done.stdout)[1:])
