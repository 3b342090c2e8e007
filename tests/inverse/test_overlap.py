"""The offset between the place of a surface and where a splat shows it."""

from dataclasses import replace

import pytest
import torch
from shared import longest, near
from small_films import cameras

from gaussian_swaying import Simulation
from gaussian_swaying.inverse.tracks import drawn_beside
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.scenes.procedural import FlagScene


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
