"""A film in a real browser."""

import base64
import re

import numpy as np
import pytest
from browsers import asked_of_a_network, listened, picture_of, until
from shared import double, longest, peak

from gaussian_swaying.cli.export import main
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
    """Opens a film in a window of a size."""
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


def test_the_film_is_the_run(show, film, run, make_flag, stretched):
    """Centres from the GPU, pictures as those of the run, scrubbing, playing; nothing is asked of a network."""
    import imageio.v3 as iio

    page, simulation = show(film), make_flag(**stretched)
    assert page.evaluate("document.getElementById('message').hidden")
    scene = simulation.scene
    size, pictures = scene.size * scene.frame.metres_per_unit, {}
    for frame in simulation.frames(6):
        if frame.index not in (0, 2, 5):
            continue
        page.evaluate(f"film.seek({frame.index})")
        assert page.evaluate("film.frame()") == frame.index
        values = page.evaluate("film.positions().then((found) => Array.from(found))")
        found = double(values).reshape(-1, 3)
        expected = scene.frame.point_to_sim(scene.deformed(frame.state).means.double()) / size
        assert longest(found - expected[order_of(scene)[1]]) < 1e-3  # of the object's size
        pictures[frame.index] = _picture(page)
        assert _psnr(pictures[frame.index], iio.imread(run / f"frames/{frame.index:05d}.png")) > 45
    assert np.abs(pictures[0] - pictures[5]).max() > 50
    assert peak(expected - scene.frame.point_to_sim(scene.rest().means.double()) / size) > 0.02
    before = page.evaluate("film.drawn()")
    page.evaluate("film.play()")
    until(lambda: page.evaluate("film.drawn()") >= before + 5)
    page.evaluate("film.pause()")
    assert page.told == asked_of_a_network(page) == []


@pytest.fixture
def own_scene(browser, run, tmp_path, request):
    """Opens the page of a user with three.js, Spark and sway.js, which a server has beside a film."""
    write_film(run, tmp_path / "flag.sway")
    assert main(["--player", str(tmp_path)]) == 0
    example, program = (request.config.rootpath / name for name in ("examples/web/three.html", "tools/player/main.js"))
    names = {
        "three": re.search(r"const three = \{(.*)\}", program.read_text(encoding="utf-8"))[1],
        "spark": "dyno, SplatGenerator",
    }
    sorted_by_script = (  # as the engine here has no WebAssembly
        "export class SparkRenderer extends window.engine.spark.SparkRenderer {"
        " constructor(options) { super(options); this.sortWorker = window.engine.makeSorter(); } }"
    )
    more = {"spark": sorted_by_script}
    page = listened(browser.new_page(viewport={"width": 320, "height": 180}))

    def serve(route):
        path = route.request.url.removeprefix("http://own.test/")
        engine = next((name for name in names if path.startswith("http") and name in path), None)
        if engine is not None:
            text = f"export const {{ {names[engine]} }} = window.engine.{engine};" + more.get(engine, "")
            route.fulfill(body=text, content_type="text/javascript", headers={"Access-Control-Allow-Origin": "*"})
        elif path == "":
            route.fulfill(body=example.read_bytes(), content_type="text/html")
        elif (tmp_path / path).is_file():
            kind = "text/javascript" if path.endswith(".js") else "application/octet-stream"
            route.fulfill(body=(tmp_path / path).read_bytes(), content_type=kind)
        else:
            route.fulfill(status=404)

    page.add_init_script(path=PAGE / "film.min.js")
    page.route("**/*", serve)
    page.goto("http://own.test/")
    yield page
    page.close()


def test_a_scene_of_ones_own_plays_a_bundle(own_scene, tmp_path):
    """In three.js with Spark, with places as the GPU computed them."""
    page, film = own_scene, read_bundle(tmp_path / "flag.sway")
    until(lambda: page.evaluate("window.shown?.splat.duration > 0"))
    page.evaluate("shown.splat.complete")
    assert page.evaluate("shown.splat.duration") == pytest.approx(0.24)

    def places():
        found = page.evaluate("Array.from(engine.positionsOf(shown.renderer, shown.spark, shown.splat.head.count))")
        return double(found).reshape(-1, 3)

    until(lambda: page.evaluate("shown.spark.activeSplats") > 0)
    fifth, second = film.moved(5)[0], film.moved(2)[0]
    page.evaluate("window.stopped = 0.24 + 0.2")
    until(lambda: longest(places() - fifth) < 1e-4)
    page.evaluate("window.stopped = 0.24 + 0.08")
    until(lambda: longest(places() - second) < 1e-4)
    assert longest(fifth - second) > 0.01
    assert page.problems == []
    wrong = page.evaluate("(new shown.splat.constructor('none.sway')).complete.catch(({ message }) => message)")
    assert wrong == "none.sway cannot be read (404)"


def test_an_element_plays_a_bundle(browser, run, tmp_path):
    """In a page of a user's, beside what `--player` wrote; a file that is not there is said."""
    write_film(run, tmp_path / "flag.sway")
    assert main(["--player", str(tmp_path)]) == 0
    page = listened(browser.new_page(viewport={"width": 320, "height": 180}))

    def serve(route):
        path = tmp_path / route.request.url.removeprefix("http://own.test/").partition("?")[0]
        kinds = {".html": "text/html", ".js": "text/javascript", ".sway": "application/vnd.gaussian-swaying"}
        if path.is_file():
            route.fulfill(body=path.read_bytes(), content_type=kinds[path.suffix])
        else:
            route.fulfill(status=404)

    for name, film in (("whole", "flag.sway"), ("none", "none.sway")):
        element = f'<gaussian-swaying src="{film}"></gaussian-swaying>'
        (tmp_path / f"{name}.html").write_text(f'<!doctype html><script src="gaussian-swaying.js"></script>{element}')
    page.route("http://own.test/**", serve)
    page.goto("http://own.test/whole.html")
    until(lambda: len(page.frames) == 2 and page.frames[1].evaluate("!!window.film"))
    assert page.frames[1].evaluate("film.seek(5).then(() => film.frame())") == 5
    found = double(page.frames[1].evaluate("film.positions().then((found) => Array.from(found))")).reshape(-1, 3)
    assert longest(found - read_bundle(tmp_path / "flag.sway").moved(5)[0]) < 1e-3  # whose stretch has no limit
    assert page.problems == []
    page.goto("http://own.test/none.html")
    message = page.frame_locator("iframe").locator("#message")
    message.filter(has_text="none.sway cannot be read (404)").wait_for()
    page.close()


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
    """The same film as if it had many Gaussians and frames: in parts, of which the first are small."""
    target = tmp_path_factory.mktemp("large") / "film.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_page, "FIRST", {"moving": 200, "still": 200})
        patch.setattr(film_page, "PART", 300)
        patch.setattr(film_page, "GROUP", 2)
        write_film(run, target)
    return target


def test_a_large_film_begins_with_some_of_its_gaussians_and_ends_as_the_same(show, film, large):
    """It plays before all has come; afterwards the picture is that of the film in one part."""
    page = show(large)
    assert page.evaluate("film.head.parts.map(([kind]) => kind).join()") == (
        "moving,still,frames,moving,frames,moving,frames"
    )
    page.evaluate("film.seek(4)")
    assert page.evaluate("film.frame()") == 4
    assert 0 < page.evaluate("film.first()") < 60
    one = show(film)
    one.evaluate("film.seek(4)")
    assert np.array_equal(_picture(page), _picture(one))
    assert page.told == []


def test_a_film_that_is_cut_short_says_so(show, large, tmp_path):
    """Within the parts that the first picture needs, and within the others, while what has come is shown."""
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
            page.wait_for_function("film.drawn() > 3")


@pytest.mark.slow
def test_controls_at_the_size_of_a_phone(show, film):
    """Slider, button and a drag; everything lies within the window."""
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
