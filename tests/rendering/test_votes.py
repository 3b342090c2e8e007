"""Labels of Gaussians from masks: the weights are those with which they are drawn."""

from dataclasses import replace

import pytest
import torch
from small_scenes import plain_cloud, together, varied_cloud

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.torch_renderer import TorchRenderer
from gaussian_swaying.rendering.votes import label_weights, scribbled, voted
from gaussian_swaying.scenes.procedural import FlagScene


def camera(eye=(0.0, -4.0, 0.3), at=(0.0, 0.0, 0.0), size=(48, 40)):
    return look_at_camera(eye, at, (0, 0, 1), 50.0, *size, 0.1)


def test_the_weights_are_those_of_the_picture():
    """Of a Gaussian drawn white among black ones, the sum over the pixels of a label."""
    cloud = varied_cloud(12)
    view = camera(eye=(1.0, -5.0, 1.0), at=(1.0, 1.0, 1.0))
    labels = torch.randint(-1, 5, (40, 48), generator=torch.Generator().manual_seed(0))
    weights = label_weights(cloud, [(view, labels)], 5)
    shape, opacity = covariance(cloud.quats, cloud.scales), torch.sigmoid(cloud.opacities)
    for k in range(len(cloud)):
        white = torch.zeros(12, 3).index_fill(0, torch.tensor([k]), 1.0)
        drawn = TorchRenderer()(cloud.means, shape, opacity, white, view).color[..., 0].double()
        expected = torch.stack([drawn[labels == c].sum() for c in range(5)])
        assert torch.allclose(weights[k], expected, rtol=1e-3, atol=1e-4)
    assert float(weights.sum()) > 10
    both = label_weights(cloud, [(view, labels), (view, labels)], 5)
    assert torch.allclose(both, 2 * weights)


def test_masks_find_the_thing_in_front():
    """Two flags, one behind the other: each mask shows what is visible of the first one."""
    front = FlagScene(spacing=0.06).generate()
    back = FlagScene(spacing=0.06).generate()
    center = front.means.mean(0)
    front = replace(front, means=front.means - center)
    back = replace(back, means=1.4 * (back.means - center) + torch.tensor([0.2, 0.8, 0.1]))
    cloud = together(front, back)
    members = torch.arange(len(cloud)) < len(front)
    views = []
    for eye in ((0.0, -3.0, 0.3), (1.5, -2.5, 0.0), (0.5, 3.5, 0.5)):
        view = camera(eye, size=(96, 80))
        white = members[:, None].float().expand(-1, 3)
        shape, opacity = covariance(cloud.quats, cloud.scales), torch.sigmoid(cloud.opacities)
        views.append((view, TorchRenderer()(cloud.means, shape, opacity, white, view).color[..., 0] > 0.5))
    label = voted(label_weights(cloud, views, 2))
    seen = label >= 0
    assert float(seen.double().mean()) > 0.9
    assert float((label[seen] == members[seen].long()).double().mean()) > 0.97


def test_unseen_gaussians_have_no_label_and_a_bias_needs_a_lead():
    weights = torch.tensor([[0.0, 0.0], [2.0, 3.0], [1.0, 9.0], [5.0, 1.0]], dtype=torch.float64)
    assert voted(weights).tolist() == [-1, 1, 1, 0]
    assert voted(weights, bias=0.5).tolist() == [-1, 0, 1, 0]
    with pytest.raises(ValueError, match="`bias`"):
        voted(weights, bias=2.0)


def test_labels_of_another_size_and_no_views_are_refused():
    cloud = varied_cloud(3)
    with pytest.raises(ValueError, match="40 rows and 48 columns"):
        label_weights(cloud, [(camera(), torch.zeros(10, 10, dtype=torch.bool))], 2)
    with pytest.raises(ValueError, match="no view"):
        label_weights(cloud, [], 2)


def balls():
    """A red and a green ball that touch."""
    draw = torch.Generator().manual_seed(0)
    clouds = []
    for x, colour in ((-0.48, (0.7, 0.3, 0.2)), (0.48, (0.3, 0.6, 0.2))):
        place = torch.randn(500, 3, generator=draw)
        cloud = plain_cloud(torch.tensor([x, 0.0, 0.0]) + 0.5 * place / place.norm(dim=-1, keepdim=True), -3.2)
        shade = torch.tensor(colour) + 0.05 * torch.randn(500, 3, generator=draw)
        clouds.append(replace(cloud, sh=((shade - 0.5) / SH_DC)[:, None]))
    return together(*clouds), torch.arange(1000) >= 500


def strokes(*places):
    """A picture with strokes of 5 pixels of 1, 2, ... beginning at places (row, column); 0 elsewhere."""
    labels = torch.zeros(40, 48, dtype=torch.long)
    for label, (row, column) in enumerate(places):
        labels[row, column : column + 5] = label + 1
    return labels


def test_a_few_scribbled_pixels_label_both_balls_from_all_sides():
    cloud, second = balls()
    view = camera()
    views = [(view, strokes((20, 15), (20, 30)))]
    label = scribbled(cloud, views)
    assert float((label == second.long()).double().mean()) > 0.99
    assert torch.equal(label, scribbled(cloud, views))
    swapped = scribbled(cloud, [(view, strokes((20, 30), (20, 15)))])
    assert torch.equal(swapped, 1 - label)


def test_scribbles_of_several_pictures_add_up():
    cloud, second = balls()
    one, other = strokes((20, 15)), 2 * (strokes((20, 15)) > 0)
    views = [(camera(), one), (camera((0.0, 4.0, 0.3)), other.long())]  # from behind, the green ball is on the left
    assert float((scribbled(cloud, views) == second.long()).double().mean()) > 0.99


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (torch.zeros(40, 48), "whole numbers from 0 on"),
        (torch.zeros(40, 48, dtype=torch.bool), "whole numbers from 0 on"),
        (strokes((20, 15)) - 1, "whole numbers from 0 on"),
        (torch.zeros(40, 48, dtype=torch.long), "have no scribble"),
        (3 * strokes((20, 15)), "none is 1"),
        (strokes((20, 15), (0, 0)), "under the scribble 2"),
        (strokes((20, 15))[:30], "30, 48"),
    ],
)
def test_scribbles_that_make_no_sense_are_refused(labels, message):
    with pytest.raises(ValueError, match=message):
        scribbled(balls()[0], [(camera(), labels)])


def test_scribbles_need_a_picture():
    with pytest.raises(ValueError, match="There is no view"):
        scribbled(balls()[0], [])
