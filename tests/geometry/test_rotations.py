"""Quaternions and rotation matrices."""

import pytest
import torch
from shared import unit

from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat


def test_quaternion_rotates_as_hamilton_product(device, dtype):
    quats, v = torch.randn(20, 4, device=device, dtype=dtype), torch.randn(20, 3, device=device, dtype=dtype)
    unit = quats / quats.norm(dim=-1, keepdim=True)
    w, u = unit[:, :1], unit[:, 1:]
    expected = v + 2 * torch.linalg.cross(u, torch.linalg.cross(u, v) + w * v)
    torch.testing.assert_close((quat_to_rotation(quats) @ v[..., None]).squeeze(-1), expected)


def test_rotation_to_quat_inverts(device, dtype):
    """Half turns about each axis included, where the formula from the trace divides by zero."""
    quats = torch.cat([torch.eye(4, dtype=torch.float64), unit(200, 4)]).to(device, dtype)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    back = rotation_to_quat(quat_to_rotation(quats))
    assert (back[:, 0] >= 0).all()
    torch.testing.assert_close(quat_to_rotation(back), quat_to_rotation(quats))
    torch.testing.assert_close(back[4:], quats[4:], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-13)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda z: quat_to_rotation(z(2, 3)), "quats"),
        (lambda z: rotation_to_quat(z(2, 3)), "rotation"),
    ],
)
def test_wrong_shapes_are_named(call, name):
    with pytest.raises(ValueError, match=rf"Expected `{name}` of shape .* but got"):
        call(torch.zeros)
