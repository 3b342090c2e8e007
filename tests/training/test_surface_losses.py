import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from lightning.pytorch.loggers import Logger
from shared import double, seeded, value_error
from torch.testing import assert_close

from gaussian_swaying.captures.capture import neighbouring_views
from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.planes import SurfaceMaps, pixel_rays
from gaussian_swaying.training.losses import LossInputs, OtherView, TotalLoss
from gaussian_swaying.training.module import SplatTrainer
from gaussian_swaying.training.surface_losses import (
    MultiViewGeometricLoss,
    MultiViewPhotometricLoss,
    SurfaceTerm,
    chosen_pixels,
    cross_correlation,
    round_trip,
    sample,
    textured,
    trust,
    warped_patches,
)

FLAT = GeneratedCapture(views=1, size=192, ripple=0.0, samples=4)
SIZE = 192


def _camera(x, z=0.4):
    return look_at_camera((x, -1.6, z), (0.6, 0.0, 0.4), (0.0, 0.0, 1.0), 30.0, SIZE, SIZE, dtype=torch.float64)


def _plane(camera, tilt=0.0, shift=0.0):
    """The surface of the flat flag (y = 0) in a view, turned about the z axis through its centre, and moved along y."""
    tilt, shift = (torch.as_tensor(value, dtype=torch.float64) for value in (tilt, shift))
    world = torch.stack([tilt.sin(), -tilt.cos(), torch.zeros_like(tilt)])
    centre = torch.stack([torch.full_like(shift, 0.6), shift, torch.full_like(shift, 0.4)])
    rotation = camera.world_to_camera[:3, :3]
    normal = rotation @ world
    distance = normal @ (rotation @ centre + camera.world_to_camera[:3, 3])
    rays = pixel_rays(camera)
    depth = distance / (rays @ normal)
    unit = normal.expand(SIZE, SIZE, 3)
    known = torch.ones(SIZE, SIZE, 1, dtype=torch.bool)
    return SurfaceMaps(unit, unit, distance.expand(SIZE, SIZE, 1), depth[..., None], known)


@cache
def _photo(x, z):
    return FLAT.render(_camera(x, z))[..., :3].double()


def _inputs(tilt=0.0, shift=0.0, apart=0.4, **changes):
    camera, other = _camera(0.6), _camera(0.6 + apart, 0.55)
    image = _photo(0.6, 0.4)
    nothing = torch.zeros(0)
    fields = {
        "image": image,
        "target": image,
        "alpha": torch.ones(SIZE, SIZE, 1),
        "target_alpha": None,
        "means": nothing,
        "quats": nothing,
        "log_scales": nothing,
        "opacities": nothing,
        "step": 10,
        "camera": camera,
        "surface": _plane(camera, tilt, shift),
        "other": OtherView(_photo(0.6 + apart, 0.55), other, _plane(other)),
    }
    return LossInputs(**(fields | changes))


def test_the_photometric_term_is_least_at_the_true_plane():
    """It grows to each side; and descending it from a degree off finds the plane.

    A tenth of a pixel of 4.5 mm, seen under 14 degrees, is 1.8 mm of height, or 0.25 degrees over 0.4 m.
    """
    term = MultiViewPhotometricLoss(start=0, samples=2000, farthest=2.0)
    values = [float(_seeded(term, _inputs(math.radians(degrees)))) for degrees in (-1.5, -0.7, 0.0, 0.7, 1.5)]
    assert values[0] > 1.1 * values[1] > 1.1 * values[2]
    assert values[4] > 1.1 * values[3] > 1.1 * values[2]
    tilt = double(math.radians(1.0)).requires_grad_()
    shift = double(0.002).requires_grad_()
    descent = torch.optim.Adam([tilt, shift], lr=1e-3)
    for _ in range(40):
        descent.zero_grad()
        _seeded(term, _inputs(tilt, shift)).backward()
        descent.step()
    assert abs(math.degrees(float(tilt.detach()))) < 0.25
    assert abs(float(shift.detach())) < 0.0018


def _seeded(term, inputs):
    torch.manual_seed(5)
    return term(inputs)


def test_round_trips_end_where_they_began_on_the_true_surface_and_elsewhere_off_it():
    camera, other = _camera(0.6), _camera(0.9)
    beside = OtherView(_photo(0.9, 0.4), other, _plane(other))
    pixel = double([[96.0, 96.0], [90.3, 102.1]])
    depth = sample(_plane(camera).depth, pixel)
    apart, seen = round_trip(pixel, depth, camera, beside)
    assert seen.all()
    assert apart.max() < 1e-3  # bilinear depths
    apart, seen = round_trip(pixel, depth + 0.01, camera, beside)
    focal = float(camera.intrinsics[0, 0])
    expected = focal * 0.01 * (0.3 / 1.6) / 1.6  # the other view sees the point 0.01 behind the sheet
    assert float(apart[0]) == pytest.approx(expected, rel=0.05)


def test_the_geometric_term_grows_with_the_distance_between_two_surfaces():
    term = MultiViewGeometricLoss(start=0, samples=500, farthest=3.0)
    values = [float(_seeded(term, _inputs(shift=shift))) for shift in (0.0, 0.004, 0.008)]
    assert values[0] < 1e-3
    assert values[0] < values[1] < values[2]


def test_what_the_other_view_does_not_show_does_not_count():
    inputs = _inputs()
    seen = inputs.other.surface
    hidden = replace(seen, depth=torch.zeros_like(seen.depth), known=torch.zeros_like(seen.known))
    other = replace(inputs.other, surface=hidden)
    for term in (MultiViewGeometricLoss(0), MultiViewPhotometricLoss(0)):
        assert term(_inputs(other=other)) == 0.0
        assert term(_inputs(other=None)) == 0.0
        assert term(_inputs(shift=0.3)) == 0.0  # round trips are longer than `farthest`


@pytest.mark.parametrize("share", [0.0, 0.002, 0.5, 1.0])
def test_a_round_trip_needs_a_surface_at_every_neighbour_of_its_pixel(share):
    """To a view from the same place, where nothing is known beside the column 50, at a share of the way there."""
    camera, plane = _camera(0.6), _plane(_camera(0.6))
    known = plane.known.clone()
    known[:, 51:] = False
    there = OtherView(_photo(0.6, 0.4), camera, replace(plane, known=known))
    pixel = double([[50.5 + share, 90.5]])
    apart, seen = round_trip(pixel, sample(plane.depth, pixel), camera, there)
    assert bool(seen) == (share == 0.0)
    if share == 0.0:
        assert apart < 1e-9


def test_a_round_trip_needs_a_pixel_of_the_other_picture():
    camera, pixel = _camera(0.6), double([[50.5, 90.5]])
    aside = look_at_camera((0.8, -1.6, 0.4), (1.4, 0.0, 0.4), (0.0, 0.0, 1.0), 30.0, SIZE, SIZE, dtype=torch.float64)
    depth = sample(_plane(camera).depth, pixel)
    assert not round_trip(pixel, depth, camera, OtherView(_photo(0.6, 0.4), aside, _plane(aside)))[1]


def test_round_trips_are_trusted_less_the_longer_they_are():
    apart = torch.tensor([0.0, 0.5, 1.9, 2.1, 0.5], requires_grad=True)
    weight = trust(apart, torch.tensor([True, True, True, True, False]), 2.0)
    assert_close(weight, torch.tensor([1.0, math.exp(-0.5), math.exp(-1.9), 0.0, 0.0]))
    assert not weight.requires_grad


def test_only_patches_that_both_pictures_show_are_compared():
    """A wall seen by two cameras side by side: one picture is the other moved by eight pixels, so that all is alike.

    Patches at the edge leave the other picture, whose right half then loses its print.
    """
    camera = look_at_camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, 64, 48, dtype=torch.float64)
    step = 8 * 2.0 / float(camera.intrinsics[0, 0])
    aside = look_at_camera((step, -2.0, 0.0), (step, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, 64, 48, dtype=torch.float64)
    wide = torch.rand(48, 72, 1, generator=seeded(0)).double().expand(48, 72, 3)
    own, moved = wide[:, :64], wide[:, 8:].clone()
    depth = torch.full((48, 64, 1), 2.0, dtype=torch.float64)
    unit = double([0.0, 0.0, -1.0]).expand(48, 64, 3)
    wall = SurfaceMaps(unit, unit, -depth, depth, torch.ones_like(depth, dtype=torch.bool))
    term = MultiViewPhotometricLoss(start=0, samples=10_000)

    def loss(picture):
        other = OtherView(picture, aside, wall)
        return float(term(_inputs(image=own, target=own, camera=camera, surface=wall, other=other)))

    assert loss(moved) < 1e-9
    assert loss(moved.flip(1)) > 0.9  # nothing is alike
    moved[:, 32:] = 0.5
    # of the columns that are compared, up to half of the patch of the three at the border has no print
    assert loss(moved) < 0.1


def test_derivatives_against_finite_differences():
    camera, inputs = _camera(0.6), _inputs()
    other = inputs.other
    pixel = double([[40.5, 47.5], [55.5, 41.5], [50.5, 60.5]])

    def trips(depth):
        return round_trip(pixel, depth, camera, other)[0]

    depth = (sample(_plane(camera).depth, pixel) + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(trips, (depth,), eps=1e-7, atol=1e-5)

    def patches(normal, distance):
        values, fine = warped_patches(pixel, normal, distance, camera, other, 2)
        assert fine.all()
        here, _ = warped_patches(pixel, start, start_distance, camera, OtherView(inputs.target, camera, None), 2)
        return cross_correlation(here.detach(), values)[0]

    plane = _plane(camera, tilt=0.01)
    start, start_distance = plane.unit[0, :3].clone(), plane.distance[0, :3].clone()
    assert torch.autograd.gradcheck(
        patches, (start.clone().requires_grad_(), start_distance.clone().requires_grad_()), eps=1e-8, atol=1e-3
    )


def test_correlations():
    one = torch.rand(4, 25)
    alike, fine = cross_correlation(one, 0.3 * one + 0.2)
    assert fine.all()
    assert_close(alike, torch.ones(4))
    assert cross_correlation(one, -one)[0].max() < -0.999
    assert not cross_correlation(one, torch.full((4, 25), 0.5))[1].any()


def test_pixels_are_chosen_off_the_border_and_where_a_surface_is():
    known = torch.zeros(20, 30, dtype=torch.bool)
    known[:, 10:] = True
    found = chosen_pixels(known, 50, 3)
    assert found.shape == (50, 2)
    assert found[:, 0].min() >= 3
    assert found[:, 0].max() <= 16
    assert found[:, 1].min() >= 10
    assert found[:, 1].max() <= 26
    assert len(chosen_pixels(known & False, 50, 3)) == 0


def test_neighbours_show_the_same_place_from_another():
    angles = [0.0, 1.0, 6.0, 14.0, 25.0, 170.0]
    cameras = [
        look_at_camera(
            (2 * math.sin(math.radians(a)), -2 * math.cos(math.radians(a)), 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0),
            40.0, 8, 8, dtype=torch.float64,
        )
        for a in angles
    ]  # fmt: skip
    cameras.append(cameras[0])
    found = neighbouring_views(cameras, count=3)
    assert found[0] == [2, 3, 4]  # not the one at the same place, nor the one that is hardly aside
    assert found[5] == []
    assert neighbouring_views(cameras, count=2, largest_angle=10.0)[4] == []
    assert neighbouring_views([]) == []


class _Surface(SurfaceTerm):
    """A term that needs the surface, and no other view: it should be flat."""

    def forward(self, inputs):
        return inputs.surface.depth.std() + inputs.surface.unit.std(0).sum()


def test_terms_begin_at_their_step_and_say_what_they_need():
    loss = TotalLoss(
        {"surface": _Surface(start=5), "views": MultiViewPhotometricLoss(start=8)}, {"views": 0.2, "surface": 0.1}
    )
    assert loss.needs(4) == frozenset()
    assert loss.needs(5) == {"surface"}
    assert loss.needs(8) == {"surface", "other_view"}
    inputs = _inputs(tilt=0.01, log_scales=torch.zeros(1, 3), opacities=torch.ones(1), step=6)
    total, values = loss(inputs)
    assert set(values) == {"rgb", "anisotropy", "entropy", "size", "surface"}
    assert torch.isfinite(total)
    with value_error(r"LossInputs\.surface"):
        MultiViewGeometricLoss(0)(_inputs(surface=None))
    with value_error("radius"):
        MultiViewPhotometricLoss(radius=0)
    with value_error("start"):
        MultiViewGeometricLoss(start=-1)


TERMS = {
    "surface": _Surface(start=2),
    "geometric": MultiViewGeometricLoss(start=3, samples=200, farthest=4.0),
    "photometric": MultiViewPhotometricLoss(start=3, samples=200, farthest=4.0),
}


def _train(data, make_trainer, terms):
    data.other_view = lambda index, pick: data.train[(index + 1 + int(pick * 2)) % len(data.train)]
    logged = []

    class Log(Logger):
        name = version = "log"

        def log_metrics(self, metrics, step=None):
            logged.append(metrics)

        def log_hyperparams(self, *_):
            pass

    torch.manual_seed(0)
    module = SplatTrainer(loss_terms=terms, sh_degree=0, log_every=1)
    make_trainer(8, logger=Log()).fit(module, data)
    return module, logged


def test_a_training_with_all_terms(data, make_trainer):
    module, logged = _train(data, make_trainer, TERMS)
    begun = [{name for name in TERMS if f"train/{name}" in row} for row in logged if "train/loss" in row]
    assert begun[:4] == [set(), set(), {"surface"}, set(TERMS)]
    assert all(row["train/photometric"] > 0 for row in logged[4:] if "train/loss" in row)
    for name, term in TERMS.items():
        without, _ = _train(data, make_trainer, {key: value for key, value in TERMS.items() if value is not term})
        assert not torch.equal(without.splat.quats, module.splat.quats), name
        assert torch.isfinite(without.splat.means).all()


@pytest.mark.gpu
def test_a_training_with_all_terms_on_a_gpu(data, make_trainer):
    _, logged = _train(data, lambda steps, **more: make_trainer(steps, accelerator="cuda", **more), TERMS)
    last = [row for row in logged if "train/loss" in row][-1]
    assert {f"train/{name}" for name in TERMS} <= set(last)
    assert all(math.isfinite(value) for value in last.values())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": 10, "stop": 10}, r"`stop` above `start` \(10\)"),
        ({"fade": 5}, "`stop` with `fade`"),
        ({"every": 0}, "`every`"),
        ({"fade": -1, "stop": 8000}, "`fade`"),
    ],
)
def test_bad_times_of_terms(options, words):
    for kind in (MultiViewGeometricLoss, MultiViewPhotometricLoss):
        with value_error(words):
            kind(**options)


def test_patches_of_one_colour_are_left_out():
    """A picture with a print in its left half: only patches that reach into it count."""
    image = torch.full((40, 60), 0.5)
    image[:, :20] += 0.1 * (torch.arange(20) % 2)
    found = textured(image, 3, 0.01)
    rows, columns = found.nonzero().unbind(-1)
    assert (int(rows.min()), int(rows.max())) == (3, 36)
    assert int(columns.min()) == 3
    assert 20 <= int(columns.max()) <= 23  # the last that reaches into it has one column of it
    assert found[3:-3, 3:20].all()
    patches = image.unfold(0, 7, 1).unfold(1, 7, 1).reshape(34 * 54, 49)
    assert torch.equal(found[3:-3, 3:-3].reshape(-1), cross_correlation(patches, patches)[1])
    assert not cross_correlation(patches, patches, contrast=0.2)[1].any()
