import dataclasses

import pytest
import torch
from shared import EYE, double, rand, seeded, value_error, without_waits
from torch.testing import assert_close

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.rotations import rotation_from_z

UPS = [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0, 1, 0], [1, 0, 0], [0.3, -0.7, 0.2], [1e-9, 0, -1]]


def _points(dtype=torch.float64):
    return torch.rand(50, 3, generator=seeded(1), dtype=dtype) * 4 - 1


@pytest.mark.parametrize("up", UPS)
def test_rotation_is_proper_and_takes_up_to_z(up):
    rotation = rotation_from_z(up).T
    direction = double(up)
    assert_close(rotation @ rotation.T, EYE, rtol=0, atol=1e-12)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)
    expected = double([0.0, 0.0, 1.0])
    assert_close(rotation @ direction / direction.norm(), expected, rtol=0, atol=1e-8)
    # by the least angle that does so, the one between up and z
    assert float(rotation.trace()) == pytest.approx(1 + 2 * float(direction[2] / direction.norm()), abs=1e-8)


def test_up_is_minus_y_has_a_closed_form():
    """(x, y, z) with y down becomes (x, z, -y): a quarter turn about x, exactly."""
    frame = SimFrame(torch.zeros(3).double(), rotation_from_z([0, -1, 0]).T, 2.0)
    point = torch.tensor([1.0, 2.0, 3.0])
    assert frame.point_to_sim(point).tolist() == [2.0, 6.0, -4.0]
    assert frame.direction_to_sim(point).tolist() == [1.0, 3.0, -2.0]
    assert frame.displacement_to_scene(torch.tensor([2.0, 6.0, -4.0])).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("up", UPS)
def test_there_and_back(up):
    placed = SimFrame.fit(_points(), up, longest_side=1.5).point_to_sim(_points())
    low, high = placed.amin(0), placed.amax(0)
    assert float((high - low).amax()) == pytest.approx(1.5, rel=1e-12)
    assert_close(low + high, torch.zeros(3).double(), rtol=0, atol=1e-12)
    for size in ({"longest_side": 1.0}, {"metres_per_unit": 0.01}, {}):
        frame = SimFrame.fit(_points(), up, **size)
        assert_close(frame.point_to_scene(frame.point_to_sim(_points())), _points(), rtol=0, atol=1e-12)
        assert_close(frame.direction_to_scene(frame.direction_to_sim(_points())), _points())
        move = frame.point_to_sim(_points() + 0.5) - frame.point_to_sim(_points())
        assert_close(frame.displacement_to_scene(move), torch.full_like(move, 0.5))


@pytest.mark.parametrize("up", UPS)
def test_covariances_and_gradients_follow_the_points(up):
    """Covariance of transformed samples = transformed covariance of samples; F_scene A F_sceneᵀ is F_sim A_sim F_simᵀ
    brought back; a gradient is turned from both sides, and none stays exactly that."""
    frame = SimFrame.fit(_points(), up, longest_side=0.7)
    covariance = torch.cov(_points().T)
    assert_close(frame.covariance_to_sim(covariance), torch.cov(frame.point_to_sim(_points()).T))
    factor = rand(5, 3, 3, generator=seeded(2))
    covariance, F = factor @ factor.mT, factor + EYE
    in_scene = frame.gradient_to_scene(F)
    in_metres = F @ frame.covariance_to_sim(covariance) @ F.mT
    assert_close(frame.covariance_to_sim(in_scene @ covariance @ in_scene.mT), in_metres)
    assert_close(in_scene, frame.rotation.T @ F @ frame.rotation)
    assert torch.equal(frame.gradient_to_scene(F.mT.contiguous().mT), in_scene)  # any strides
    eye = torch.eye(3).expand(4, 3, 3)
    assert torch.equal(frame.gradient_to_scene(eye), eye)
    assert frame.turns == (up != [0, 0, 1])


def test_metres_per_unit_is_taken_as_it_is():
    frame = SimFrame.fit(_points(), metres_per_unit=0.25)
    assert frame.metres_per_unit == 0.25
    distance = torch.linalg.vector_norm(frame.point_to_sim(_points())[0] - frame.point_to_sim(_points())[1])
    assert float(distance) == pytest.approx(0.25 * float((_points()[0] - _points()[1]).norm()))
    assert SimFrame.fit(_points()).metres_per_unit == 1.0
    assert frame.area_to_sim(torch.tensor(16.0)) == 1.0


def test_what_a_frame_keeps_is_its_own():
    with torch.inference_mode():
        frame = SimFrame.fit(_points(), [0, 1, 0], metres_per_unit=2.0)
        frame.point_to_sim(_points())
        frame.direction_to_sim(_points().float())
    other = dataclasses.replace(frame, origin=frame.origin.clone() + 1, rotation=rotation_from_z([1, 0, 0]).T)
    expected = (_points() - other.origin) @ other.rotation.T * 2.0
    assert_close(other.point_to_sim(_points()), expected)
    points = _points().requires_grad_()
    other.direction_to_sim(points).sum().backward()
    assert_close(points.grad, other.rotation.sum(0).expand(50, 3))
    assert frame.direction_to_sim(_points().float()).dtype == torch.float32


@pytest.mark.gpu
@pytest.mark.parametrize("up", [[0, 0, 1], [0.3, -0.7, 0.2]])
def test_a_second_conversion_copies_nothing(up):
    frame, points = SimFrame.fit(_points(), up, longest_side=1.0), _points(torch.float32)
    matrices = torch.rand(50, 3, 3)
    names = ["point_to_sim", "point_to_scene", "displacement_to_scene", "direction_to_sim", "direction_to_scene"]
    calls = [(name, points) for name in names]
    calls += [(name, matrices) for name in ("covariance_to_sim", "gradient_to_scene")]
    calls = [(name, value, value.cuda()) for name, value in calls]
    for name, _, value in calls:
        getattr(frame, name)(value)
    with without_waits():
        found = [getattr(frame, name)(value) for name, _, value in calls]
    for (name, value, _), result in zip(calls, found, strict=True):
        assert_close(result.cpu(), getattr(frame, name)(value), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("up", [[0, 0, 1], [0.3, -0.7, 0.2]])
def test_a_scene_far_away_keeps_its_detail(up):
    """float32 at 1e4 resolves 1e-3; what the file holds must come through to float32 round-off of the object's size."""
    stored = (_points() + 1e4).float()
    frame = SimFrame.fit(stored, up, longest_side=1.0)
    near = frame.point_to_sim(stored)
    exact = (stored.double() - stored.double()[0]) @ rotation_from_z(up) * frame.metres_per_unit
    assert_close((near - near[0]).double(), exact, rtol=0, atol=3e-7)
    assert torch.equal(frame.point_to_scene(near.double()).float(), stored)


def test_bad_arguments():
    points = _points()
    with value_error(r"either `longest_side` or `metres_per_unit`"):
        SimFrame.fit(points, longest_side=1.0, metres_per_unit=1.0)
    with value_error(r"`up` to be a direction"):
        SimFrame.fit(points, [0, 0, 0])
    with value_error(r"`up` to have 3 numbers"):
        SimFrame.fit(points, [0, 1])
    with value_error(r"no extent .*`metres_per_unit`"):
        SimFrame.fit(points[:1], longest_side=1.0)
    for name in ("longest_side", "metres_per_unit"):
        with value_error(name):
            SimFrame.fit(points, **{name: 0.0})
    with value_error("points"):
        SimFrame.fit(points[:, :2])


def test_one_point_is_enough_without_a_size():
    frame = SimFrame.fit(torch.tensor([[1.0, 2.0, 3.0]]))
    assert frame.point_to_sim(torch.tensor([1.0, 2.0, 4.0])).tolist() == [0.0, 0.0, 1.0]
