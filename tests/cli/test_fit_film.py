"""``gaussian-swaying fit FILM --splat SPLAT``: what it writes before the fit, what it asks for, and the result."""

import dataclasses
import math
import re
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
import torch
import yaml
from flag_film import TRUTH, camera_of, write_case
from PIL import Image
from shared import refused, seeded, value_error
from small_scenes import guess

import gaussian_swaying
from gaussian_swaying.cli.fit import main
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.inverse import from_film
from gaussian_swaying.inverse.from_film import extent, longest_side, open_film, plan_text
from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.registration import painter_of
from gaussian_swaying.inverse.report import HELD_TINT, MOVING
from gaussian_swaying.inverse.videos import read_videos
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.rendering.cameras.camera import project

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    write_case(folder, size=(270, 480), still=0.3, moving=0.7, spacing=0.025)
    return folder


def _check(case, output, *more, film="film.mp4"):
    given = [str(case / film), "--splat", str(case / "my.ply"), "--up", "+z", "--output", str(output)]
    return main([*given, *more, "--device", "cpu", "--check"])


@pytest.fixture(scope="module")
def checked(case):
    folder = case / "out"
    assert _check(case, folder, "--length", "pole", "2.5", "--focal", "36.2") == 0
    return folder


def test_the_file_that_a_fit_reads(checked):
    plan = read_plan(checked / "fit.yaml")
    assert [u.name for u in plan.unknowns] == ["wind.speed", "wind.azimuth", "material.E", "film.start"]
    for u in plan.unknowns[:3]:
        assert u.low < TRUTH[u.name] < u.high
    assert plan.assumed == ["mass"]
    base = yaml.safe_load((checked / "preview/starter.yaml").read_text())
    assert base["scene"]["longest_side"] == pytest.approx(1.2, rel=0.03)
    assert plan.known["background"] == pytest.approx([0.9 * 0.45, 0.9 * 0.5 * 0.94, 0.9 * 0.55 * 0.82], abs=0.02)
    (video,) = read_videos(plan.videos)
    assert video.size == (270, 480)
    assert len(video.times) == pytest.approx(30, abs=2)
    eye = camera_of(270, 480).position
    assert (video.cameras[0].position - eye).norm() < 0.02 * eye.norm()


def test_a_film_is_fitted_from_python_as_from_the_command_line(case, checked, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(from_film, "run_fit", lambda plan, output, **settings: (plan, output, settings))
    given = {"up": "+z", "focal": 36.2, "device": "cpu", "progress": False}
    film, splat, output = case / "film.mp4", case / "my.ply", tmp_path / "out"
    plan, folder, settings = gaussian_swaying.fit_film(film, splat, output, length=("pole", 2.5), **given)
    same = read_plan(checked / "fit.yaml")
    for name in ("unknowns", "known", "assumed", "until", "search"):
        assert getattr(plan, name) == getattr(same, name)
    assert (folder, settings["in_use"]) == (output / "result", [output / "fit.yaml"])
    assert capsys.readouterr().out == ""
    with pytest.raises((TypeError, ValueError), match="`length` of fit_film"):
        gaussian_swaying.fit_film(film, splat, output, length=2.5)


def test_the_pictures_before_the_fit(checked):
    rest = np.asarray(Image.open(checked / "result/before/rest_0.png")).astype(float)[22:]
    frame, _, splat, roles = np.split(rest, 4, axis=1)
    cloth = (np.abs(roles - 255 * np.array(MOVING)) < 30).all(-1)
    held = (np.abs(roles - 255 * np.array(HELD_TINT)) < 30).all(-1)
    assert cloth.sum() > 5 * held.sum() > 0
    assert np.nonzero(held)[1].max() < np.nonzero(cloth)[1].mean()
    grey = [picture[cloth].mean(-1) for picture in (frame, splat)]
    assert np.corrcoef(*grey)[0, 1] > 0.9
    tracks = np.asarray(Image.open(checked / "result/before/tracks_0.png")).astype(float)[22:]
    blue = (tracks[..., 2] - tracks[..., 0] > 120).nonzero()
    assert len(blue[0]) > 100
    assert Image.open(checked / "registration.png").size == (3 * 270, 480 + 22)


def test_a_film_that_does_not_say_its_length(case, checked, tmp_path):
    with (case / "film.mkv").open("wb") as file:  # ffmpeg cannot go back to write the length
        words = ["-v", "error", "-i", str(case / "film.mp4"), "-c", "copy", "-f", "matroska", "-"]
        subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words], check=True, stdout=file)
    assert _check(case, tmp_path / "out", "--focal", "36.2", film="film.mkv") == 0
    (video,), (same,) = (read_videos(folder / "transforms.json") for folder in (tmp_path / "out", checked))
    assert video.times == pytest.approx(same.times, abs=2e-3)


@pytest.fixture(scope="module")
def seen(case):
    film, cloud, camera = open_film(case / "film.mp4"), read_gaussians(case / "my.ply", 0), camera_of(270, 480)
    return cloud, camera, painter_of(cloud)(camera), film.full, guess(cloud)


def test_known_lengths(seen):
    """All say that the pole is 2.5 m high, which is the longest side of all."""
    ends = project(torch.tensor([[-0.03, 0.0, 0.8], [-0.03, 0.0, -1.3]]), camera_of(270, 480))[0]
    places = ":".join(f"{x:.0f},{y:.0f}" for x, y in ends.tolist())
    for name, metres in (("object", 2.5), ("pole", 2.5), ("cloth", 1.2), (places, 2.1)):
        assert longest_side(name, metres, *seen) == pytest.approx(2.5, rel=0.03), name


@pytest.mark.parametrize(
    ("name", "told"),
    [("mast", "no part 'mast': `--length` may name cloth, pole, object"), ("5,5:10,10", "is not on the splat"),
     ("5:9", "two places"), ("5,5:9999,9", "is not on the splat")],
)  # fmt: skip
def test_lengths_of_nothing(seen, name, told):
    with value_error(told):
        longest_side(name, 2.0, *seen)


def test_the_extent_does_not_depend_on_the_turn():
    share = torch.rand(4000, 2, generator=seeded(0))
    for angle in (0.0, 0.5, 0.785):
        points = torch.stack([share[:, 0] * math.cos(angle), share[:, 0] * math.sin(angle), share[:, 1]], 1)
        assert extent(points, [0.0, 0.0, 1.0]) == pytest.approx(1.0, abs=0.01)


def test_a_fit_without_a_length_keeps_the_edited_file(case, checked, capsys):
    edited = (checked / "fit.yaml").read_text() + "tracks: 30\n"
    (checked / "fit.yaml").write_text(edited)
    assert _check(case, checked) == 0
    assert "nobody measured" in capsys.readouterr().out
    assert (checked / "fit.1.yaml").read_text() == edited
    plan = yaml.safe_load((checked / "fit.yaml").read_text())
    plan |= {"search": 0, "iterations": 1, "until": 0.4}
    plan["known"] |= {"solver.dx": 0.06}
    (checked / "small.yaml").write_text(yaml.safe_dump(plan))
    assert main(["--config", str(checked / "small.yaml"), "--output", str(case / "result"), "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    assert "In its own lengths the speed is" in told
    assert "weigh it" in told
    page = (case / "result/page.html").read_text()
    files = re.findall('src="([^"]+)"', page)
    assert len(files) == 3
    assert all((case / "result" / file).stat().st_size > 0 for file in files)
    assert "wind.azimuth" in page


def test_what_hangs_may_blow_anywhere(case, checked):
    """No direction is at an end of the range."""
    found = guess(read_gaussians(case / "my.ply", 0))
    hangs = dataclasses.replace(found, hold=dataclasses.replace(found.hold, name="top"))
    (checked / "hangs.yaml").write_text(plan_text(hangs, [0.5, 0.5, 0.5], 0.1, ("pole", 2.5), checked))
    plan = read_plan(checked / "hangs.yaml")
    (azimuth,) = [u for u in plan.unknowns if u.name == "wind.azimuth"]
    assert azimuth.high - azimuth.low > 360
    assert plan.assumed == ["mass"]


FILM = ["film.mp4", "--splat", "a.ply"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "either a film"),
        (["film.mp4"], "add --splat"),
        ([*FILM, "--config", "b.yaml"], "either a film"),
        (["--config", "b.yaml", "--up", "+z"], "`--up` is for a film"),
        ([*FILM, "--resume"], "`--resume`"),
        ([*FILM, "--length", "pole", "long"], "a length in metres"),
        ([*FILM, "--length", "pole"], "but got nothing"),
        ([*FILM, "--focal", "0.03"], "`--focal` from 5 to 1000 mm"),
        ([*FILM, "--up", "north"], "`--up` to be +x"),
        ([*FILM, "--up", "0", "1"], "or 3 numbers, but got 0 1"),
        ([*FILM, "--hold", "left"], "`--hold`"),
        (["film.png", "--splat", "a.ply"], "is a picture"),
        (FILM, "film.mp4"),
    ],
)
def test_bad_options(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refused(main, words, capsys, told, folder=tmp_path)


@pytest.mark.parametrize(
    ("shown", "told"), [(False, "was not found in the first frame"), (True, "Nothing moves in the film")]
)
def test_films_that_do_not_work(case, shown, told, capsys):
    first = open_film(case / "film.mp4").first.numpy() if shown else np.full((480, 270, 3), 90, np.uint8)
    encoder = VideoEncoder(case / "other.mp4", 30)
    for _ in range(5):
        encoder.write(first)
    encoder.finish()
    splat, out = str(case / "my.ply"), str(case / "bad")
    refused(main, [str(case / "other.mp4"), "--splat", splat, "--output", out], capsys, told)
