import base64

import pytest
import torch
from browsers import asked_of_a_network, until
from shared import longest, merged

from gaussian_swaying.player.live_web.block import check, pack_solver
from gaussian_swaying.player.live_web.page import PAGE

from .conftest import apart, drawn_apart, opened
from .test_block import CASES, OBSTACLES, run

LOST = "WebGPU is not used, as {}: the processor computes the motion."

ASK = """async ([program, block, messages, solver, last]) => {
  const url = URL.createObjectURL(new Blob([program], { type: "text/javascript" }));
  const worker = new Worker(url);
  const answers = [];
  let [moved, ready] = [null, false];
  const result = await new Promise((resolve, reject) => {
    worker.onerror = (event) => reject(new Error(event.message));
    worker.onmessage = ({ data }) => {
      if (data.kind === "state") moved = Array.from(data.moved);
      else answers.push(data);
      if (!ready && data.kind === "solver" && (data.name === "webgpu" || data.why)) {
        ready = true;
        for (const message of messages) worker.postMessage(message);
      }
      if (data.kind === "failed" || data.kind === "done" || data.why === last) resolve({ answers, moved });
    };
    const bytes = Uint8Array.from(atob(block), (letter) => letter.charCodeAt(0));
    worker.postMessage({ kind: "load", bytes });
    worker.postMessage({ kind: "solver", which: solver });
  });
  worker.terminate();
  return result;
}"""


@pytest.fixture(scope="module")
def context(shading_browser, tmp_path_factory):
    """A context of a Chromium with WebGPU, and an empty page of it."""
    empty = tmp_path_factory.mktemp("empty") / "empty.html"
    empty.write_text("<!doctype html><title>Empty</title>")
    made = shading_browser.new_context(viewport={"width": 600, "height": 400})
    made.empty = made.new_page()
    made.empty.goto(empty.as_uri())
    if not made.empty.evaluate("navigator.gpu?.requestAdapter().then((adapter) => !!adapter)"):
        pytest.skip("this Chromium offers WebGPU no adapter in software")
    return made


@pytest.fixture
def on_gpu(context):
    """Runs the worker alone with WebGPU: its answers but the first, and the last nodes (M, 3)."""

    def on_gpu(simulation, *messages, before="", solver="webgpu", last=""):
        check(simulation)
        nodes = simulation.scene.follow.nodes(simulation.start())
        block = base64.b64encode(pack_solver(simulation, nodes)).decode()
        program = before + (PAGE / "worker.min.js").read_text()
        told = context.empty.evaluate(ASK, [program, block, list(messages), solver, last])
        return told["answers"][1:], torch.tensor(told["moved"]).reshape(len(nodes), 4)[:, :3]

    return on_gpu


@pytest.fixture
def show(context):
    pages = []

    def show(path, settings=""):
        pages.append(opened(context, path, settings))
        return pages[-1]

    yield show
    for page in pages:
        page.close()


def both(one, other, part=None):
    return merged(CASES[one], {part: CASES[other][part]} if part else CASES[other])


MIXED = {
    "two laws, schedule, paper": both("two laws, schedule", "neo-hookean, paper", "aero"),
    "hencky, cross flow, clamp": both("hencky, cross flow", "clamp"),
    "springs, viscous, pinned points": both("springs, viscous", "nodes and a point, still air", "solver"),
    "linear, semi-implicit": CASES["linear, semi-implicit"],
    "one patch, cross flow": CASES["one patch, cross flow"],
    "bending": CASES["bending"],
    "turbulence": CASES["effects"],
}


@pytest.mark.parametrize("name", MIXED)
def test_laws_forces_and_boundaries(make, on_gpu, name):
    simulation = make(**MIXED[name])
    state, steps = run(simulation, 10)
    told, moved = on_gpu(simulation, {"kind": "frames", "count": 10})
    assert [told[0]["name"], told[-1]["gpu"]] == ["webgpu", True]
    error, motion = apart(simulation, state, moved)
    assert motion > 5e-3
    assert error < 1e-4
    assert told[-1]["substeps"] == steps


def test_a_page_after_two_seconds_and_after_its_device_is_lost(show, written, make):
    """Within 1 % of the motion. Then the processor goes on with the motion, and the page says so."""
    page = show(written, "#solver=webgpu")
    page.evaluate("windPage.complete.then(() => windPage.tunnel.setPlaying(false))")
    until(lambda: page.evaluate("windPage.state.solver") == "webgpu")
    page.evaluate("windPage.tunnel.reset()")
    assert page.evaluate("windPage.advance(50)")["gpu"]
    error, motion = drawn_apart(page, make())
    assert motion > 0.1
    assert error < 0.01
    assert not page.locator("#note").is_visible()
    page.evaluate("windPage.say({ kind: 'lose' })")
    told = page.evaluate("windPage.advance(10)")
    assert told["kernels"]
    assert page.evaluate("windPage.state.solver") == "webassembly"
    assert page.evaluate("windPage.tunnel.playback.newest ?? 0") == pytest.approx(2.4)
    assert drawn_apart(page, make())[0] < 0.01
    assert page.locator("#note").inner_text() == LOST.format(page.evaluate("windPage.state.why"))
    assert asked_of_a_network(page) == []


def test_chosen_by_hand(show, written):
    page = show(written, "")
    until(lambda: page.evaluate("windPage.state.why") == "it would run on the processor")
    assert page.evaluate("windPage.state.solver") == "webassembly"
    assert not page.locator("#note").is_visible()
    for name, solver in {"webgpu": "webgpu", "worker": "webassembly"}.items():
        before = page.evaluate("windPage.tunnel.playback.newest ?? 0")
        page.evaluate(f"location.hash = 'solver={name}'")
        until(lambda solver=solver: page.evaluate("windPage.state.solver") == solver)
        until(lambda before=before: page.evaluate("windPage.tunnel.playback.newest ?? 0") > before)
        assert f"solver={name}" in page.evaluate("windPage.tunnel.link()")
    assert page.told == []
    page = show(written, "#solver=worker")
    until(lambda: page.evaluate("windPage.tunnel.playback.newest ?? 0") > 0)
    assert [page.evaluate("windPage.state.solver"), page.evaluate("windPage.state.why")] == ["webassembly", None]


BROKEN = "GPUDevice.prototype.createComputePipelineAsync = () => Promise.reject(new Error('no pipeline'));"
OTHER = "Object.defineProperty(GPUAdapter.prototype, 'info', { value: { vendor: 'other' } });"
ABSENT = "Object.defineProperty(navigator, 'gpu', { value: undefined });"
REASONS = {
    "its device failed: no pipeline": (BROKEN, {}),
    "this browser does not offer it": (ABSENT, {}),
    "something touches the material": ("", {"solver": {"boundaries": OBSTACLES["ground and ball"]}}),
}


@pytest.mark.parametrize("why", REASONS)
def test_where_there_is_no_webgpu_the_processor_computes(make, on_gpu, why):
    before, changes = REASONS[why]
    told, moved = on_gpu(make(**changes), {"kind": "frames", "count": 1}, before=before)
    assert told[0] == {"kind": "solver", "name": "webassembly", "why": why}
    assert told[-1]["kernels"]
    assert longest(moved) > 0


def test_where_webgpu_is_slower_the_processor_computes(make, on_gpu):
    told, _ = on_gpu(
        make(), {"kind": "run", "on": True, "speed": 1e3}, before=OTHER, solver="auto", last="it is too slow here"
    )
    assert [answer["name"] for answer in told] == ["webgpu", "webassembly"]
