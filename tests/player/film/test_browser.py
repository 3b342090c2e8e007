import base64
import json
import re
import subprocess
import tarfile

import numpy as np
import pytest
from browsers import asked_of_a_network, listened, picture_of, until
from shared import double, longest, peak

from gaussian_swaying.cli.export import main
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.player.film import page as film_page
from gaussian_swaying.player.film.page import PAGE, read_bundle, write_film
from gaussian_swaying.player.film.recorded import order_of

SHOWN = "!!window.film || !document.getElementById('message').textContent.startsWith('Loading')"


LOW = {"class_path": "Box", "init_args": {"min": [None, None, 0.2], "max": [None] * 3}}


@pytest.fixture(scope="module")
def stretched(flags):
    """Many Gaussians are drawn at the limit, a part stands still, and two flags have their own nodes."""
    return {"scene": flags | {"max_stretch": 1.03, "region": LOW}}


@pytest.fixture(scope="module")
def run(make_flag, stretched, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stretched") / "flag"
    make_flag(**stretched).run(folder, 6, progress=False)
    return folder


@pytest.fixture(scope="module")
def film(run, tmp_path_factory):
    target = tmp_path_factory.mktemp("film") / "film.html"
    write_film(run, target)
    return target


@pytest.fixture
def show(browser):
    opened = []

    def show(path, width=320, height=180, browser=browser):
        opened.append(listened(browser.new_page(viewport={"width": width, "height": height})))
        opened[-1].goto(path.as_uri())
        until(lambda: opened[-1].evaluate(SHOWN))
        return opened[-1]

    yield show
    for page in opened:
        page.close()


def _picture(page):
    """The canvas as it is shown, without the controls."""
    page.add_style_tag(content="header, footer { display: none !important; }")
    return picture_of(page)


def _psnr(one, other):
    return 10 * np.log10(255**2 / np.mean((one - other) ** 2))


@pytest.fixture(scope="module")
def moved(make_flag, stretched):
    """Places of the Gaussians in some frames of the run, in the order of its film and in its units, by frame."""
    simulation, found = make_flag(**stretched), {}
    scene = simulation.scene
    for frame in simulation.frames(6):
        means = scene.deformed(frame.state).means.double()[order_of(scene)[1]]
        found[frame.index] = scene.frame.point_to_sim(means) / (scene.size * scene.frame.metres_per_unit)
    return found


def test_the_film_is_the_run(show, film, run, moved):
    import imageio.v3 as iio

    page, pictures = show(film), {}
    assert page.evaluate("document.getElementById('message').hidden")
    for frame in (0, 2, 5):
        page.evaluate(f"film.seek({frame})")
        assert page.evaluate("film.frame()") == frame
        values = page.evaluate("film.view.positions().then((found) => Array.from(found))")
        assert longest(double(values).reshape(-1, 3) - moved[frame]) < 1e-4  # of the object's size
        pictures[frame] = _picture(page)
        assert _psnr(pictures[frame], iio.imread(run / f"frames/{frame:05d}.png")) > 45
    assert np.abs(pictures[0] - pictures[5]).max() > 50
    assert peak(moved[5] - moved[0]) > 0.02
    before = page.evaluate("film.view.drawn")
    page.evaluate("film.play()")
    until(lambda: page.evaluate("film.view.drawn") >= before + 5)
    page.evaluate("film.pause()")
    assert page.told == asked_of_a_network(page) == []


@pytest.fixture
def served(browser, run, tmp_path):
    write_film(run, tmp_path / "flag.sway")
    assert main(["--player", str(tmp_path)]) == 0
    page = listened(browser.new_page(viewport={"width": 320, "height": 180}))
    page.add_init_script(path=PAGE / "film.min.js")
    kinds = {".html": "text/html", ".js": "text/javascript", ".sway": "application/vnd.gaussian-swaying"}

    def served(text, **engines):
        def serve(route):
            other, _, own = route.request.url.partition("http://own.test/")
            path = tmp_path / own.partition("?")[0]
            if other:
                body = next(body for name, body in engines.items() if f"{name}@" in other)
                headers = {"Access-Control-Allow-Origin": "*"}
                route.fulfill(body=body, content_type="text/javascript", headers=headers)
            elif path.is_file():
                route.fulfill(body=path.read_bytes(), content_type=kinds[path.suffix])
            else:
                route.fulfill(status=404)

        (tmp_path / "index.html").write_text(text)
        page.route("**/*", serve)
        page.goto("http://own.test/index.html")
        return page

    yield served
    assert page.problems == []
    page.close()


@pytest.fixture
def three(request):
    """Three.js and Spark, which our player has inside."""
    text = (request.config.rootpath / "tools/player/main.js").read_text(encoding="utf-8")
    names = re.search(r"const three = \{(.*)\}", text)[1]
    sorted_by_script = (  # as the engine here has no WebAssembly
        "export class SparkRenderer extends window.engine.spark.SparkRenderer {"
        " constructor(options) { super(options); this.sortWorker = window.engine.makeSorter(); } }"
    )
    return {
        "three": f"export const {{ {names} }} = window.engine.three;",
        "spark": f"export const {{ dyno, SplatGenerator }} = window.engine.spark; {sorted_by_script}",
    }


@pytest.fixture
def playcanvas(request, tmp_path):
    lock = json.loads((request.config.rootpath / "tools/player/package-lock.json").read_text(encoding="utf-8"))
    known = lock["packages"]["node_modules/playcanvas"]
    command = ["npm", "pack", "--json", f"playcanvas@{known['version']}"]
    try:
        told = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=200, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        pytest.skip("needs npm and its registry")
    (packed,) = json.loads(told)
    assert packed["integrity"] == known["integrity"]
    with tarfile.open(tmp_path / packed["filename"]) as archive:
        return {"playcanvas": archive.extractfile("package/build/playcanvas.min.mjs").read()}


ELEMENT = '<!doctype html><script src="gaussian-swaying.js"></script><gaussian-swaying src="{}"></gaussian-swaying>'
DRAWN = {
    "three": """async () => shown.spark.activeSplats > 0
        ? Array.from(engine.positionsOf(shown.renderer, shown.spark, shown.splat.head.count)) : []""",
    "playcanvas": """async () => {
        if (!(shown.splat.sorted >= 0)) return [];
        const [camera] = shown.app.renderer.gsplatDirector.camerasMap.values();
        const [{ gsplatManager }] = camera.layersMap.values();
        const made = gsplatManager.world.workBuffer.getTexture("dataTransformA");
        const found = new Float32Array((await made.read(0, 0, made.width, made.height)).buffer);
        return Array.from({ length: 3 * shown.splat.container.numSplats }, (_, k) => {
            const i = 4 * Math.floor(k / 3); // y is up there
            return [found[i], -found[i + 2], found[i + 1]][k % 3];
        });
    }""",
}


@pytest.fixture
def example(request, served):
    def example(name):
        text = (request.config.rootpath / f"examples/web/{name}.html").read_text(encoding="utf-8")
        page = served(text, **request.getfixturevalue(name))
        until(lambda: page.evaluate("window.shown?.splat?.duration > 0"))
        assert page.evaluate("shown.splat.complete.then(() => shown.splat.duration)") == pytest.approx(0.24)
        return page

    return example


def _shown(page, name, frame):
    """Rows of places that an example draws at a time after the first round, which may be those of a time before."""
    page.evaluate(
        "(time) => Object.assign(shown.splat, { playing: false, time: (window.stopped = time) })", 0.24 + 0.04 * frame
    )
    return page.evaluate(DRAWN[name])


@pytest.mark.parametrize("name", ["element", *DRAWN])
def test_players_agree(name, served, example, moved, tmp_path):
    """Centres from the GPU, within 0.01 % of the size of those of the run, and of the film as numpy reads it."""
    if name == "element":
        page = served(ELEMENT.format("flag.sway"))
        until(lambda: len(page.frames) == 2 and page.frames[1].evaluate("!!window.film"))
        drawn = "async (frame) => { await film.seek(frame); return Array.from(await film.view.positions()); }"
    else:
        page = example(name)
    film = read_bundle(tmp_path / "flag.sway")

    def agrees(frame, expected):
        values = page.frames[1].evaluate(drawn, frame) if name == "element" else _shown(page, name, frame)
        found = double(values).reshape(-1, 3)
        return len(found) > 0 and longest(found - expected) < 1e-4

    for frame in (5, 2):
        until(lambda frame=frame: agrees(frame, film.moved(frame)[0]))
        assert agrees(frame, moved[frame])
    assert longest(moved[5] - moved[2]) > 0.01


def test_playcanvas_has_the_shapes_of_a_film(example, tmp_path):
    """Rotations and sizes where the limit of stretch does nothing, and colours where light does nothing."""
    page, film = example("playcanvas"), read_bundle(tmp_path / "flag.sway")
    until(lambda: len(_shown(page, "playcanvas", 2)) > 0)
    read = """async (name) => {
        const made = shown.splat.container.getTexture(name);
        return Array.from(await made.read(0, 0, made.width, made.height));
    }"""
    turn, size, color = (
        double(np.array(page.evaluate(read, f"data{name}"), np.uint16).view(np.float16)).reshape(-1, 4)[
            : film.head["count"]
        ]
        for name in ("Rotation", "Scale", "Color")
    )
    expected, rest = film.moved(2)[1], film.moved(0)[1]
    trace, before = (shape.diagonal(dim1=-2, dim2=-1).sum(-1) for shape in (expected, rest))
    free = trace < before * film.head["max_stretch"] ** 2
    assert free.double().mean() > 0.5
    error = (covariance(turn, size[:, :3].log()) - expected).abs().amax((-1, -2)) / trace
    assert peak(error[free]) < 2e-3
    still = film.head["moving"]
    assert peak(color[still:] - double(film.color[still:]) / 255) < 1e-3


def test_a_film_that_is_not_there_is_said(served, three, request):
    page = served((request.config.rootpath / "examples/web/three.html").read_text(encoding="utf-8"), **three)
    until(lambda: page.evaluate("!!window.shown"))
    wrong = page.evaluate("(new shown.splat.constructor('none.sway')).complete.catch(({ message }) => message)")
    assert wrong == "none.sway cannot be read (404)"
    message = served(ELEMENT.format("none.sway")).frame_locator("iframe").locator("#message")
    message.filter(has_text="none.sway cannot be read (404)").wait_for()


def test_gaussians_are_sorted_from_far_to_near(show, film):
    """Equal depths keep their order; what is infinitely far or has a negative depth is not drawn."""
    page = show(film)
    depths = np.random.default_rng(0).uniform(90, 110, 100_000).astype(np.float32)
    depths[::3] = depths[::3].round()
    depths[::7] *= np.float32(1e-3)
    depths[5:40:5] = [np.inf, 0.0, 3e38, 1e-40, -1.0, -np.inf, np.nan]
    code = base64.b64encode(depths.tobytes()).decode()
    told = page.evaluate(
        """async (code) => {
            const bytes = Uint8Array.from(atob(code), (letter) => letter.charCodeAt(0));
            return Array.from(await film.order(new Float32Array(bytes.buffer)));
        }""",
        code,
    )
    with np.errstate(invalid="ignore"):
        drawn = np.flatnonzero((depths >= 0) & (depths < np.inf))
    assert told == drawn[np.argsort(-depths[drawn], kind="stable")].tolist()
    assert len(told) == len(depths) - 4
    assert page.evaluate("film.order([]).then((found) => found.length)") == 0


@pytest.fixture(scope="module")
def large(run, tmp_path_factory):
    target = tmp_path_factory.mktemp("large") / "film.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_page, "FIRST", {"moving": 200, "still": 200})
        patch.setattr(film_page, "PART", 300)
        patch.setattr(film_page, "GROUP", 2)
        write_film(run, target)
    return target


def test_a_large_film_begins_with_some_of_its_gaussians_and_ends_as_the_same(show, film, large):
    page = show(large)
    assert page.evaluate("film.head.parts.map(([kind]) => kind).join()") == (
        "moving,still,frames,moving,frames,moving,frames"
    )
    page.evaluate("film.seek(4)")
    assert page.evaluate("film.frame()") == 4
    assert 0 < page.evaluate("film.view.first") < 60
    one = show(film)
    one.evaluate("film.seek(4)")
    assert np.array_equal(_picture(page), _picture(one))
    assert page.told == []


def test_a_film_that_is_cut_short_says_so(show, large, tmp_path):
    sentence = "The file of this film is cut short: copy it again, or export it again."
    content = large.read_text()
    ends = {name: content.index(f'id="film-{name}"') for name in ("code", "part-1", "part-4", "part-6")}
    for k, (end, shown) in enumerate(
        ((ends["code"] + 5000, False), (ends["part-1"] - 30, False), (ends["part-1"] + 300, False),
         (ends["part-4"] - 3, True), (ends["part-6"] + 300, True))
    ):  # fmt: skip
        (tmp_path / f"{k}.html").write_text(content[:end])
        page = show(tmp_path / f"{k}.html")
        place = page.locator("#note" if shown else "#message")
        place.filter(has_text=sentence).wait_for()
        assert page.locator("#message").is_visible() is not shown
        if shown:
            page.wait_for_function("film.view.drawn > 3")


@pytest.mark.slow
def test_controls_at_the_size_of_a_phone(show, film):
    page = show(film, 390, 844)
    page.locator("#play").click()
    page.evaluate("film.seek(0)")
    first = _whole(page)
    page.locator("#time").focus()
    page.keyboard.press("End")
    page.evaluate("film.seek(film.frame())")
    assert page.evaluate("film.frame()") == 5
    assert page.locator("#clock").inner_text() == "0.20 / 0.20 s"
    second = _whole(page)
    assert np.abs(first - second).max() > 50
    page.mouse.move(195, 420)
    page.mouse.down()
    page.mouse.move(285, 420, steps=3)
    page.mouse.up()
    page.evaluate("film.seek(5)")
    assert np.abs(_whole(page) - second).max() > 50
    for name in ("#play", "#time", "#clock", "#loop"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["y"] + box["height"] <= 844
    page.locator("#loop").click()
    assert page.locator("#loop").get_attribute("aria-pressed") == "false"
    assert page.told == []


def _whole(page):
    return picture_of(page, x=0, y=100, width=390, height=600)


def test_a_browser_without_webgl2_says_so(show, film, launch):
    page = show(film, browser=launch("--disable-gpu", "--disable-3d-apis"))
    message = page.locator("#message")
    assert message.is_visible()
    assert message.inner_text() == (
        "This film needs WebGL2, which this browser lacks or has switched off: open it in a current browser."
    )
    assert page.told == []
