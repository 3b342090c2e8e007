"""The camera of a frame, and a first look at a film."""

import json
import math
from dataclasses import replace

import pytest
import torch
from handheld_films import tripod, write_film
from shared import randn, seeded, value_error
from small_films import changed

from gaussian_swaying import Simulation
from gaussian_swaying.inverse.fit import Problem, fit
from gaussian_swaying.inverse.registration import FOUND, cameras_around, find_camera, first_look, shown_in
from gaussian_swaying.inverse.videos import read_videos
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.scenes.procedural import FlagScene

pytest.importorskip("cv2", reason="needs the extra [fit]")
WIDTH, HEIGHT, FOV = 320, 240, 45.0
MIDDLE, EYE, UP = torch.tensor([0.6, 0.0, 0.4]), [1.1, -1.7, 0.9], [0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def draw():
    """Pictures of a printed flag at rest, which bulges so that its depth differs."""
    simulation = Simulation(FlagScene(spacing=0.012, pattern="printed", ripple=0.06), device="cpu")
    painter, state = simulation.painter, simulation.stepper.start()
    gaussians = painter.deformed(state)

    def picture(camera):
        with torch.no_grad():
            return painter.picture(gaussians, camera)

    return picture


@pytest.fixture(scope="module")
def truth():
    return look_at_camera(EYE, MIDDLE, UP, FOV, WIDTH, HEIGHT, dtype=torch.float64)


@pytest.fixture(scope="module")
def frame(draw, truth):
    """In another light: darker from left to right, warmer, and with the noise of a sensor."""
    colour = draw(truth).color.double().clamp(0, 1)
    light = torch.linspace(1.0, 0.5, WIDTH, dtype=torch.float64)[None, :, None] * torch.tensor([1.0, 0.9, 0.7])
    noise = 0.01 * randn(colour.shape, generator=seeded(0))
    return (255 * (light * colour**1.2 + noise).clamp(0, 1)).round().to(torch.uint8)


def _off(camera, truth):
    """Angle between two cameras [degrees], and their distance per that to the middle of the flag."""
    a, b = camera.world_to_camera.double()[:3, :3], truth.world_to_camera[:3, :3]
    angle = math.degrees(math.acos(min(1.0, float(((a @ b.T).trace() - 1) / 2))))
    return angle, float((camera.position.double() - truth.position).norm() / (truth.position - MIDDLE).norm())


def test_from_a_camera_that_is_near(draw, frame, truth):
    near = look_at_camera([0.7, -2.2, 0.6], [0.55, 0.0, 0.45], UP, FOV, WIDTH, HEIGHT, dtype=torch.float64)
    found = find_camera(draw, frame, [near])
    angle, distance = _off(found.camera, truth)
    assert angle < 0.5
    assert distance < 0.01
    assert found.agreeing > 0.5 * found.matches
    assert found.residual < 1.0


def test_from_no_camera(draw, frame, truth):
    around = cameras_around(MIDDLE, 2.2, UP, FOV, WIDTH, HEIGHT)
    angle, distance = _off(find_camera(draw, frame, around).camera, truth)
    assert angle < 0.5
    assert distance < 0.01


def test_with_the_focal_length(draw, frame, truth):
    near = look_at_camera([0.7, -2.2, 0.6], MIDDLE, UP, 1.15 * FOV, WIDTH, HEIGHT, dtype=torch.float64)
    found = find_camera(draw, frame, [near], focal=True).camera
    assert float(found.intrinsics[0, 0] / truth.intrinsics[0, 0]) == pytest.approx(1, abs=0.03)
    assert _off(found, truth)[0] < 0.7


def test_what_cannot_be_found_is_refused(draw, truth):
    with value_error("was not found in the frame"):
        find_camera(draw, torch.full((HEIGHT, WIDTH, 3), 90, dtype=torch.uint8), [truth])


SPEED, BEFORE = {"wind.speed": [2.0, 12.0]}, {"film.start": [-0.4, 0.0]}


@pytest.fixture
def plain(tmp_path):
    """Another splat, of stripes, where the flag was."""
    flag = {"width": 0.4, "height": 0.3, "spacing": 0.02, "ripple": 0.0, "pattern": "stripes", "yaw": 180.0}
    return changed(tmp_path, scene={"generator": {"class_path": "FlagScene", "init_args": flag}})


def test_a_film_of_the_splat_is_as_its_camera_says(own, simulation):
    for video in read_videos(own / "video"):
        assert first_look(simulation, video, None) == []


def test_a_splat_that_is_not_in_the_film_is_said_before_anything_else(own, plain, simulation):
    """Also if the film is of nothing at all; a film in motion may look like anything at rest."""
    video, _ = read_videos(own / "video")
    with value_error("The first frame of camera left does not show the splat where its camera looks"):
        first_look(plain, video, None)
    assert first_look(plain, video, -0.4) == []
    noise = torch.randint(0, 255, video.images.shape, generator=torch.Generator().manual_seed(0))
    with value_error("camera noise does not show the splat"):
        first_look(simulation, replace(video, name="noise", images=noise.to(torch.uint8)), 0.0)


@pytest.mark.parametrize("factor", [0.8, 1.3])
@pytest.mark.parametrize("earliest", [None, -0.4])
def test_a_camera_in_another_unit_is_said(room, plan_of, tmp_path, factor, earliest):
    """And not that the film begins in motion, whether that is among the unknowns or not."""
    write_film(room, tmp_path, [tripod(320, 180)] * 4)
    (right,), file = read_videos(tmp_path), tmp_path / "transforms.json"
    plan = plan_of(SPEED | (BEFORE if earliest else {}))
    data = json.loads(file.read_text())
    for row in data["frames"][0]["transform_matrix"][:3]:
        row[3] *= factor
    file.write_text(json.dumps(data))
    (video,) = read_videos(tmp_path)
    (told,) = first_look(room, video, earliest)
    assert float(told.split("the splat ")[1].split()[0]) == pytest.approx(factor, rel=0.15)
    assert "in another unit than the splat, or it is another camera" in told
    assert Problem(room, [video], plan, doubts=[told]).notes() == [told]
    assert first_look(room, right, earliest) == []


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
