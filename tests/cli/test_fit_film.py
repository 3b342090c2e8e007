"""``gaussian-swaying fit FILM --splat SPLAT``: what it writes before the fit, what it asks for, and the result.

Covers: fitting.before, fitting.page.
"""

import math

import numpy as np
import pytest
import torch
import yaml
from bench.problems.flag_film import TRUTH, camera_of, write_case
from PIL import Image
from shared import refused

from gaussian_swaying.cli.fit import main
from gaussian_swaying.cli.fit_film import extent
from gaussian_swaying.fitting.before import HELD, MOVING
from gaussian_swaying.fitting.film import first_frame, open_film
from gaussian_swaying.fitting.plan import read_plan
from gaussian_swaying.fitting.videos import read_videos
from gaussian_swaying.recording.video import VideoEncoder

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A flag on its pole, and a film of it."""
    folder = tmp_path_factory.mktemp("film")
    write_case(folder, size=(270, 480), still=0.3, moving=0.7, spacing=0.025)
    return folder


@pytest.fixture(scope="module")
def checked(case):
    """The files before a fit, with the pole's length."""
    folder = case / "out"
    given = [
        str(case / "film.mp4"),
        "--splat",
        str(case / "my.ply"),
        "--length",
        "pole",
        "2.5",
        "--up",
        "+z",
        "--focal",
        "36.2",
    ]
    assert main([*given, "--output", str(folder), "--device", "cpu", "--check"]) == 0
    return folder


def test_the_file_that_a_fit_reads(checked):
    """The scale is that of the pole, and the part of the film begins before the motion."""
    plan = read_plan(checked / "fit.yaml")
    assert [u.name for u in plan.unknowns] == ["wind.speed", "wind.azimuth", "material.E", "film.start"]
    for u in plan.unknowns[:3]:
        assert u.low < TRUTH[u.name] < u.high
    assert plan.assumed == ["mass"]
    base = yaml.safe_load((checked / "preview/draft.yaml").read_text())
    assert base["scene"]["longest_side"] == pytest.approx(1.2, rel=0.03)
    assert plan.known["background"] == pytest.approx([0.9 * 0.45, 0.9 * 0.5 * 0.94, 0.9 * 0.55 * 0.82], abs=0.02)
    (video,) = read_videos(plan.videos)
    assert video.size == (270, 480)
    assert len(video.times) == pytest.approx(30, abs=2)
    eye = camera_of(270, 480).position
    assert float((video.cameras[0].position - eye).norm()) < 0.02 * float(eye.norm())


def test_the_pictures_before_the_fit(checked):
    """The frame and the splat show the same; the pole's edge is held; the free edge is followed."""
    rest = np.asarray(Image.open(checked / "result/before/rest_0.png")).astype(float)[22:]
    frame, _, splat, roles = np.split(rest, 4, axis=1)
    cloth = (np.abs(roles - 255 * np.array(MOVING)) < 30).all(-1)
    held = (np.abs(roles - 255 * np.array(HELD)) < 30).all(-1)
    assert cloth.sum() > 5 * held.sum() > 0
    assert np.nonzero(held)[1].max() < np.nonzero(cloth)[1].mean()
    grey = [picture[cloth].mean(-1) for picture in (frame, splat)]
    assert np.corrcoef(*grey)[0, 1] > 0.9
    tracks = np.asarray(Image.open(checked / "result/before/tracks_0.png")).astype(float)[22:]
    blue = (tracks[..., 2] - tracks[..., 0] > 120).nonzero()
    assert len(blue[0]) > 100
    assert Image.open(checked / "registration.png").size == (3 * 270, 480 + 22)


def test_an_edited_file_is_kept_and_a_check_of_it_works(case, checked, capsys):
    edited = (checked / "fit.yaml").read_text() + "tracks: 30\n"
    (checked / "fit.yaml").write_text(edited)
    assert main(["--config", str(checked / "fit.yaml"), "--output", str(checked / "result"), "--check"]) == 0
    assert "tracks_0.png" in capsys.readouterr().out
    given = [str(case / "film.mp4"), "--splat", str(case / "my.ply"), "--output", str(checked), "--check"]
    assert main([*given, "--length", "object", "2.5", "--up", "+z"]) == 0
    assert (checked / "fit.1.yaml").read_text() == edited


def test_a_length_between_two_places_of_the_first_frame(case):
    """The pole from its ball to its foot, as the true camera sees them."""
    from gaussian_swaying.rendering.cameras.camera import project

    ends = torch.tensor([[-0.03, 0.0, 0.8], [-0.03, 0.0, -1.3]])
    pixel = project(ends, camera_of(270, 480))[0]
    name = ":".join(f"{x:.0f},{y:.0f}" for x, y in pixel.tolist())
    given = [str(case / "film.mp4"), "--splat", str(case / "my.ply"), "--length", name, "2.1", "--up", "+z"]
    assert main([*given, "--output", str(case / "places"), "--check"]) == 0
    base = yaml.safe_load((case / "places/preview/draft.yaml").read_text())
    assert base["scene"]["longest_side"] == pytest.approx(1.2, rel=0.05)


def test_the_extent_does_not_depend_on_the_turn():
    """A square cloth is as long as its side, however it is turned about the vertical, and not as its diagonal."""
    share = torch.rand(4000, 2, generator=torch.Generator().manual_seed(0))
    for angle in (0.0, 0.5, 0.785):
        points = torch.stack([share[:, 0] * math.cos(angle), share[:, 0] * math.sin(angle), share[:, 1]], 1)
        assert extent(points, [0.0, 0.0, 1.0]) == pytest.approx(1.0, abs=0.01)


def test_without_a_length_the_result_says_what_follows(case, capsys):
    """A very small fit to its end: the page, and the sentence on what the values rest on."""
    given = [str(case / "film.mp4"), "--splat", str(case / "my.ply"), "--up", "+z", "--output", str(case / "own")]
    assert main([*given, "--check"]) == 0
    assert "nobody measured" in capsys.readouterr().out
    text = (case / "own/fit.yaml").read_text().replace("search: 48", "search: 0\nstages: [tracks]\niterations: 1")
    (case / "own/fit.yaml").write_text(text)
    assert main(["--config", str(case / "own/fit.yaml"), "--output", str(case / "own/result"), "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    assert "In its own lengths the speed is" in told
    assert "weigh it" in told
    assert "sees the wind blow to the" in told
    page = (case / "own/result/page.html").read_text()
    assert page.count("data:video/mp4;base64,") == 1
    assert page.count("data:image/jpeg;base64,") == 3
    assert "wind.azimuth" in page


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "either a film"),
        (["film.mp4"], "add --splat"),
        (["film.mp4", "--splat", "a.ply", "--config", "b.yaml"], "either a film"),
        (["--config", "b.yaml", "--up", "+z"], "`--up` is for a film"),
        (["film.mp4", "--splat", "a.ply", "--resume"], "`--resume`"),
        (["film.mp4", "--splat", "a.ply", "--length", "pole", "long"], "a length in metres"),
        (["film.mp4", "--splat", "a.ply", "--focal", "0.03"], "`--focal` from 5 to 1000 mm"),
        (["film.mp4", "--splat", "a.ply"], "film.mp4"),
    ],
)
def test_bad_options(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refused(main, words, capsys, told, folder=tmp_path)


def test_films_and_lengths_that_do_not_work(case, capsys):
    film, splat, out = str(case / "film.mp4"), str(case / "my.ply"), str(case / "bad")
    for name, told in (("mast", "no part 'mast'"), ("5,5:10,10", "is not on the splat"), ("5:9", "two places")):
        refused(main, [film, "--splat", splat, "--length", name, "2", "--output", out], capsys, told)
    for name, shown, told in (("grey", False, "was not found in the first frame"), ("still", True, "Nothing moves")):
        encoder = VideoEncoder(case / f"{name}.mp4", 30)
        first = first_frame(open_film(film)).numpy() if shown else np.full((480, 270, 3), 90, np.uint8)
        for _ in range(10):
            encoder.write(first)
        encoder.finish()
        refused(main, [str(case / f"{name}.mp4"), "--splat", splat, "--output", out], capsys, told)
