import json
import subprocess

import numpy as np
import pytest
import torch
import yaml
from browsers import listened, until
from shared import double, longest, merged
from small_scenes import GREEN, block, previewed

from gaussian_swaying.player.film.recorded import order_of
from gaussian_swaying.player.live_web.block import check, pack_solver
from gaussian_swaying.player.live_web.page import PAGE, write_live_web
from gaussian_swaying.simulation.simulation import Simulation

SIDE = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.06, None, None]}}
CALM = {
    "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.05, "width": 0.6, "height": 0.4}}},
    "material": {"E": 2e4, "nu": 0.3, "density": 60.0, "thickness": 0.02},
    "solver": {
        "dx": 0.1,
        "damping": 2.0,
        "boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": SIDE}}],
    },
    "wind": {
        "flow": [1.0, 2.0, 0.3],
        "seed": 3,
        "modulations": [
            {"class_path": "SineSway", "init_args": {"amplitude": 0.3, "period": 1.5}},
            {"class_path": "GaussianGust", "init_args": {"std": 0.3}},
            {"class_path": "UniformGust", "init_args": {"delta": 0.2, "interval": 0.1}},
        ],
    },
    "aero": {"C_D": 0.5, "C_F": 0.3, "C_L": 0.05, "law": "projected"},
    "camera": {"class_path": "OrbitCamera", "init_args": {"width": 320, "height": 180, "azimuth": -70.0}},
    "background": [0.5, 0.6, 0.7],
}


SHOWN = "!!window.windPage || !document.getElementById('message').textContent.startsWith('Loading')"


def maker(settings, tmp_path_factory):
    """Makes the simulation of a configuration, with some settings changed."""

    def make(**changes):
        path = tmp_path_factory.mktemp("made") / "made.yaml"
        path.write_text(yaml.safe_dump(merged(settings, changes)))
        return Simulation.from_yaml(path, device="cpu")

    return make


@pytest.fixture(scope="session")
def make(tmp_path_factory):
    return maker(CALM, tmp_path_factory)


@pytest.fixture(scope="session")
def sway(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shrub")
    previewed(block([0.5, 0.4, 1.0], GREEN), folder, hold="bottom", kind="shrub", look="gusts")
    return maker(yaml.safe_load((folder / "starter.yaml").read_text()), tmp_path_factory)


@pytest.fixture(scope="session")
def written(make, tmp_path_factory):
    target = tmp_path_factory.mktemp("page") / "sheet.html"
    write_live_web(make(), "sheet", target)
    return target


@pytest.fixture
def in_node(node, request, tmp_path):
    """Runs the built solver in Node.js: its answers, and the last nodes (M, 3)."""

    def run(simulation, *messages):
        check(simulation)
        state = simulation.start()
        nodes = simulation.scene.follow.nodes(state)
        (tmp_path / "block").write_bytes(pack_solver(simulation, nodes))
        script = request.config.rootpath / "tools/player/live_web/run.js"
        command = [node, script, PAGE / "worker.min.js", tmp_path / "block", tmp_path / "state", json.dumps(messages)]
        told = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        moved = np.fromfile(tmp_path / "state", "<f4").reshape(len(nodes), 4)[:, :3]
        return json.loads(told.stdout), torch.from_numpy(moved.copy())

    return run


def moved_means(simulation, state, moved):
    """Centres of the Gaussians with the nodes moved (M, 3) as a browser says; the state gives the type."""
    nodes = simulation.scene.follow.nodes(state)
    still = torch.zeros_like(state.node_displacement)
    displacement = still.index_copy(0, nodes, moved.to(still))
    return simulation.scene.deformed(simulation.solver.bound.read_particles(state, displacement, still)).means


def apart(simulation, state, moved):
    expected = simulation.scene.deformed(state).means
    motion = longest(expected - simulation.scene.rest().means)
    error = longest(moved_means(simulation, state, moved) - expected)
    return float(error / motion), float(motion)


def opened(context, path, settings):
    page = listened(context.new_page())
    page.goto(path.as_uri() + settings)
    until(lambda: page.evaluate(SHOWN))
    return page


def drawn_apart(page, simulation):
    values = page.evaluate("windPage.tunnel.positions().then((found) => Array.from(found))")
    found = double(values).reshape(-1, 3)
    state = simulation.start()
    for _ in range(round(page.evaluate("windPage.tunnel.playback.newest ?? 0") / simulation.frame_dt)):
        state, _ = simulation.advance(state)
    scene = simulation.scene
    size, order = scene.size * scene.frame.metres_per_unit, order_of(scene)[1]
    rest, expected = (
        scene.frame.point_to_sim(drawn.means.double())[order] / size for drawn in (scene.rest(), scene.deformed(state))
    )
    motion = float(longest(expected - rest))
    return float(longest(found - expected)) / motion, motion
