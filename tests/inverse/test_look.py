"""A first look: a splat that is not in the film, and cameras in another unit."""

import json
from dataclasses import replace

import pytest
import torch
from handheld_films import tripod, write_film
from shared import value_error
from small_films import changed

from gaussian_swaying.inverse.fit import Problem, fit
from gaussian_swaying.inverse.registration import FOUND, first_look, shown_in
from gaussian_swaying.inverse.videos import read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")

SPEED, BEFORE = {"wind.speed": [2.0, 12.0]}, {"film.start": [-0.4, 0.0]}


@pytest.fixture
def plain(tmp_path):
    """Another splat, of stripes, where the flag was."""
    flag = {"width": 0.4, "height": 0.3, "spacing": 0.02, "ripple": 0.0, "pattern": "stripes", "yaw": 180.0}
    return changed(tmp_path, scene={"generator": {"class_path": "FlagScene", "init_args": flag}})


def test_a_film_of_the_splat_is_as_its_camera_says(own, simulation):
    for video in read_videos(own / "video"):
        assert first_look(simulation, video, False) == []


def test_a_splat_that_is_not_in_the_film_is_said_before_anything_else(own, plain, simulation):
    """Also if the film is of nothing at all; a film in motion may look like anything at rest."""
    video, _ = read_videos(own / "video")
    with value_error("The first frame of camera left does not show the splat where its camera looks"):
        first_look(plain, video, False)
    assert first_look(plain, video, True) == []
    noise = torch.randint(0, 255, video.images.shape, generator=torch.Generator().manual_seed(0))
    with value_error("camera noise does not show the splat"):
        first_look(simulation, replace(video, name="noise", images=noise.to(torch.uint8)), False)


@pytest.mark.parametrize("factor", [0.8, 1.3])
@pytest.mark.parametrize("moving", [False, True])
def test_a_camera_in_another_unit_is_said(room, plan_of, tmp_path, factor, moving):
    """And not that the film begins in motion, whether that is among the unknowns or not."""
    write_film(room, tmp_path, [tripod(320, 180)] * 4)
    (right,), file = read_videos(tmp_path), tmp_path / "transforms.json"
    plan = plan_of(SPEED | (BEFORE if moving else {}))
    data = json.loads(file.read_text())
    for row in data["frames"][0]["transform_matrix"][:3]:
        row[3] *= factor
    file.write_text(json.dumps(data))
    (video,) = read_videos(tmp_path)
    (told,) = first_look(room, video, moving)
    assert float(told.split("the splat ")[1].split()[0]) == pytest.approx(factor, rel=0.15)
    assert "in another unit than the splat, or it is another camera" in told
    assert Problem(room, [video], plan, looked=[told]).notes() == [told]
    assert first_look(room, right, moving) == []


def test_a_fit_says_it_first(own, plain, tmp_path):
    """Nothing is written."""
    with value_error("does not show the splat"):
        fit(tmp_path / "made.yaml", own / "video", SPEED, tmp_path / "fit", device="cpu", progress=False)
    assert not (tmp_path / "fit").exists()


def test_what_is_not_there_is_not_alike(own, plain):
    """By a wide margin on both sides."""
    (video, _) = read_videos(own / "video")
    rest, painter = plain.scene.rest(), plain.painter
    picture = painter.picture(rest, video.cameras[0])
    drawn = (255 * picture.color.detach().clamp(0, 1)).round().to(torch.uint8)
    assert shown_in(picture, drawn)[0] > 3 * FOUND
    assert shown_in(picture, video.images[0])[0] < 0.5 * FOUND
