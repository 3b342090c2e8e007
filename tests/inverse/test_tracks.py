"""The tracker: pictures that are shifted by a known amount, and a simulation that is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from handheld_films import photographed
from shared import longest, near
from small_films import cameras, changed

from gaussian_swaying import Simulation
from gaussian_swaying.inverse.tracks import _inside, drawn_beside, follow, match, track, window_of
from gaussian_swaying.inverse.variants import states_of
from gaussian_swaying.inverse.videos import Footage, read_videos
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.scenes.procedural import FlagScene

cv2 = pytest.importorskip("cv2", reason="needs the extra [fit]")


@pytest.mark.parametrize(("size", "side"), [((200, 120), 15), ((540, 960), 15), ((1080, 1920), 29), ((3840, 2160), 57)])
def test_the_window_grows_with_the_picture(size, side):
    assert window_of(*size) == side


def test_follow_a_shift():
    rows, columns = np.mgrid[0:80, 0:100].astype("f4")

    def picture(x, y):
        wave = np.sin(0.35 * (columns - x)) * np.cos(0.3 * (rows - y)) + np.sin(0.21 * (rows - y) + 0.1 * (columns - x))
        return np.repeat((127 + 55 * wave)[..., None], 3, -1).round().astype("u1")

    shifts = [(0.0, 0.0), (0.7, -0.4), (1.9, -0.9), (3.2, -1.1)]
    start = np.stack(np.meshgrid(np.arange(25, 75, 10.0), np.arange(25, 55, 10.0)), -1).reshape(-1, 2)
    position, seen = follow(np.stack([picture(*shift) for shift in shifts]), start)
    assert seen.all()
    for k, shift in enumerate(shifts):
        assert np.abs(position[k] - start - shift).max() < 0.05


def test_a_point_that_vanishes_is_lost():
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (60, 60, 3), dtype="u1"), (7, 7), 0)
    plain = np.full_like(picture, 128)
    _, seen = follow(np.stack([picture, picture, plain]), np.array([[20.0, 20.0], [30.0, 40.0], [45.0, 25.0]]))
    assert seen[1].all()
    assert not seen[2].any()


def _off(tracks, state, frame):
    """How far its points that are seen in a frame are from where a state has them [pixels]."""
    seen = tracks.seen[frame]
    return (tracks.pixels(tracks.shown([state]), frame)[0] - tracks.position[frame])[seen]


def test_matches_do_not_drift(own, simulation):
    """Against the truth: tracks go astray by a pixel or so, matches from a nearby simulation by a part of that."""
    videos = read_videos(own / "video")
    times = list(videos[0].times)
    truth = [states[0] for states in states_of(simulation, [{}], times)]
    near = [states[0] for states in states_of(simulation, [{"wind.speed": 4.7, "material.E": 1.2e4}], times)]
    for video in videos:
        tracks, matches = track(simulation, video), match(simulation, video, near)
        off = {}
        for name, found in (("tracks", tracks), ("matches", matches)):
            parts = [_off(found, truth[k], k) for k in range(4, len(times))]
            off[name] = float(torch.cat(parts).norm(dim=-1).median())
        assert off["matches"] < 0.25
        assert off["matches"] < off["tracks"] < 2


def test_a_shift_that_is_there_at_rest_is_taken_off_matches(own, simulation):
    """The same video, said to be from cameras whose pictures are shifted by a part of a pixel."""
    video = read_videos(own / "video")[0]
    turned = []
    for camera in video.cameras:
        intrinsics = camera.intrinsics.clone()
        intrinsics[:2, 2] += torch.tensor([0.6, -0.4])
        turned.append(replace(camera, intrinsics=intrinsics))
    times = video.times[:5]
    states = [found[0] for found in states_of(simulation, [{}], times)]
    video = replace(video, cameras=tuple(turned))
    matches = match(simulation, video, states)
    for k in range(len(times)):  # the simulation is the truth
        off = _off(matches, states[k], k).median(0).values
        assert off.tolist() == pytest.approx([0.0, 0.0], abs=0.05)


def _printed(folder, spacing):
    """Simulation of a printed flag, 0.4 m x 0.3 m."""
    flag = {"width": 0.4, "height": 0.3, "spacing": spacing, "ripple": 0.0, "pattern": "printed", "overlap": 0.5}
    return changed(folder, scene={"generator": {"class_path": "FlagScene", "init_args": flag}})


@pytest.mark.slow(gate=["False"])
@pytest.mark.parametrize("real", [True, False])
def test_matches_are_not_shifted_where_the_print_of_a_splat_is(real, tmp_path):
    """Cameras on both sides of a flag at rest, from which the print of its splat is shifted to opposite sides.

    A video of the thing itself shows its print where it is; one that the splat made shows what the simulation shows.
    """
    simulation = _printed(tmp_path, 0.01)
    painter, gaussians = simulation.painter, simulation.scene.rest()
    views = [look_at_camera((0.2 + x, -0.5, 0.35), (0.2, 0.0, 0.15), (0, 0, 1), 45.0, 240, 180) for x in (-0.5, 0.5)]
    drawn = [painter.picture(gaussians, view).color.detach() for view in views]
    own = [(255 * picture.clamp(0, 1)).round().to(torch.uint8) for picture in drawn]
    images = [photographed(view, [(0.4, 0.3, 0.0, (0.0, 0.0, 0.0))]) for view in views] if real else own
    rest = next(iter(states_of(simulation, [{}], [0.0])))[0]
    found = match(simulation, Footage("moved", (0.0, 0.1), tuple(views), torch.stack(images)), [rest, rest])
    means = simulation.scene.model.means.detach()[simulation.scene.moving[found.index]]
    for k, view in enumerate(views):
        pixel = project(means, view)[0]
        off = (found.position[k] - pixel)[found.seen[k]].median(0).values
        beside = drawn_beside(painter, gaussians, view, pixel)[found.seen[k]].median(0).values
        assert beside.norm() > 0.5
        assert off.norm() < 0.1


def test_windows_over_the_border_are_left_out_unless_the_thing_is_thin():
    """Of a square of 60 pixels, and of a stripe of 8."""
    places = torch.cartesian_prod(torch.arange(2.5, 100, 5), torch.arange(2.5, 100, 5)).double()
    for low, high, thin in ((20, 80, False), (46, 54, True)):
        alpha = torch.zeros(100, 100, 1)
        alpha[:, low:high] = 1
        alpha[:20], alpha[80:] = 0, 0
        picture = RenderOutput(torch.zeros(100, 100, 3), alpha, torch.ones(100, 100, 1))
        on = alpha[places[:, 1].long(), places[:, 0].long(), 0] > 0
        inside = _inside(places, picture, on)
        assert torch.equal(inside, on if thin else (places > 27).all(-1) & (places < 73).all(-1))


def test_what_a_window_shows_is_beside_the_centres_of_its_gaussians(simulation):
    """Against pictures of one Gaussian after the other: white, behind and in front of black ones."""
    painter, camera = simulation.painter, cameras()["left"]
    gaussians, opacity = painter.scene.rest(), painter.scene.model.opacity()
    centres = project(gaussians.means, camera)[0]
    rows, columns = torch.meshgrid(torch.arange(120) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    field = torch.zeros(120, 200, 3)
    for k, centre in enumerate(centres):
        colours = torch.zeros(len(centres), 3)
        colours[k] = 1
        white = painter.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera).color[..., 0]
        field += white[..., None] * torch.stack([columns - centre[0], rows - centre[1], torch.ones_like(rows)], -1)
    column, row = centres[20].long().tolist()
    window = field[row - 7 : row + 8, column - 7 : column + 8].sum((0, 1))
    found = drawn_beside(painter, gaussians, camera, centres[20:21])[0]
    assert found.norm() > 0.5
    near(found.float(), window[:2] / window[2], 1e-3)
    assert drawn_beside(painter, gaussians, camera, centres[:0]).shape == (0, 2)


def test_the_edge_of_a_picture_does_not_cut_gaussians(simulation):
    """The offset near the edge is that in a wider picture."""
    painter, camera = simulation.painter, cameras()["left"]
    gaussians = painter.scene.rest()
    left = float(project(gaussians.means, camera)[0][:, 0].median())
    lens = camera.intrinsics - torch.tensor([[0.0, 0.0, left - 3], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    cut, place = replace(camera, intrinsics=lens), torch.tensor([[3.0, 60.0]])
    whole = drawn_beside(painter, gaussians, camera, place + torch.tensor([[left - 3, 0.0]]))
    found = drawn_beside(painter, gaussians, cut, place)
    assert whole.norm() > 0.3
    assert (found - whole).norm() < 0.3 * whole.norm()


def test_large_gaussians_have_no_part_in_it(simulation, monkeypatch):
    """Some haze in front of all, whose centre is far from every window."""
    painter, camera = simulation.painter, cameras()["left"]
    gaussians, opacity = painter.scene.rest(), painter.opacity()
    places = project(gaussians.means, camera)[0][20:22]
    known = drawn_beside(painter, gaussians, camera, places)
    eye = camera.position.to(gaussians.means)
    haze = eye + 0.5 * (gaussians.means[:1] - eye)
    means = torch.cat([gaussians.means, haze])
    covariances = torch.cat([gaussians.covariances, 0.2**2 * torch.eye(3)[None]])
    monkeypatch.setattr(type(painter), "opacity", lambda self: torch.cat([opacity, torch.tensor([0.05])]))
    hazy = replace(gaussians, means=means, covariances=covariances)
    assert longest(drawn_beside(painter, hazy, camera, places) - known) < 0.1


@pytest.mark.gpu
def test_on_a_gpu_it_is_that_of_a_cpu(tmp_path):
    found = {}
    for device in ("cpu", "cuda"):
        own = Simulation(FlagScene(0.4, 0.3, 0.02, pattern="printed", ripple=0.02), device=device)
        rest, camera = own.scene.rest(), cameras()["left"].to(own.device)
        found[device] = drawn_beside(own.painter, rest, camera, project(rest.means, camera)[0])
    assert (found["cuda"] - found["cpu"]).norm(dim=-1).median() < 0.05
