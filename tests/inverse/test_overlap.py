"""The offset between the place of a surface and where a splat shows it."""

from dataclasses import replace

import pytest
import torch
from shared import longest, near
from small_films import cameras

from gaussian_swaying import Simulation
from gaussian_swaying.inverse import tracks as overlap
from gaussian_swaying.inverse.tracks import drawn_beside
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.scenes.procedural import FlagScene


def test_where_a_gaussian_is_drawn_is_the_mean_of_its_pixels(simulation):
    """Against pictures of one Gaussian after the other: white, behind and in front of black ones."""
    painter, camera = simulation.painter, cameras()["left"]
    gaussians, opacity = painter.scene.rest(), painter.scene.model.opacity()
    centres = project(gaussians.means, camera)[0]
    rows, columns = torch.meshgrid(torch.arange(120) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    sums = torch.zeros(len(centres), 3)
    for k in range(len(centres)):
        colours = torch.zeros(len(centres), 3)
        colours[k] = 1
        white = painter.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera).color[..., 0]
        sums[k] = torch.stack([white.sum(), (white * columns).sum(), (white * rows).sum()])
    shift = sums[:, 1:] / sums[:, :1] - centres
    assert longest(shift) > 1
    field = torch.zeros(120, 200, 3)
    for k in range(len(centres)):
        colours = torch.zeros(len(centres), 3)
        colours[k] = torch.cat([shift[k], torch.ones(1)])
        field += painter.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera).color
    column, row = centres[20].long().tolist()
    window = field[row - 7 : row + 8, column - 7 : column + 8].sum((0, 1))
    found = drawn_beside(painter, gaussians, camera, centres[20:21])[0]
    near(found.float(), window[:2] / window[2], 1e-3)


def test_only_the_surroundings_of_windows_are_drawn(simulation, monkeypatch):
    """And what is found is that of the whole picture."""
    painter, camera = simulation.painter, cameras()["left"]
    move = torch.tensor([[0.0, 0.0, 200.0], [0.0, 0.0, 120.0], [0.0, 0.0, 0.0]])
    camera = replace(camera, intrinsics=camera.intrinsics + move, width=600, height=360)
    gaussians = painter.scene.rest()
    places = project(gaussians.means, camera)[0][20:22]
    drawn = []
    hook = painter.renderer.register_forward_hook(lambda _, given, out: drawn.append(out.color[..., 0].numel()))
    found = drawn_beside(painter, gaussians, camera, places)
    assert max(drawn) < 0.5 * 600 * 360
    monkeypatch.setattr(overlap, "AROUND", 30.0)
    near(found, drawn_beside(painter, gaussians, camera, places), 1e-3)
    assert drawn[-1] > 2 * max(drawn[:2])
    hook.remove()
    assert drawn_beside(painter, gaussians, camera, places[:0]).shape == (0, 2)


def test_any_number_of_windows_is_averaged_in_parts(simulation, monkeypatch):
    painter, camera = simulation.painter, cameras()["left"]
    gaussians = painter.scene.rest()
    pixel = project(gaussians.means, camera)[0]
    known = drawn_beside(painter, gaussians, camera, pixel)
    monkeypatch.setattr(overlap, "MANY", 7)
    torch.testing.assert_close(drawn_beside(painter, gaussians, camera, pixel), known)


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
