import torch
from shared import near, randn, seeded, unit
from torch.testing import assert_close

from gaussian_swaying.geometry.rotations import quat_multiply, quat_to_rotation, rotation_of, rotation_to_quat, turn_of


def test_quaternion_rotates_as_hamilton_product(device, dtype):
    quats, v = torch.randn(20, 4, device=device, dtype=dtype), torch.randn(20, 3, device=device, dtype=dtype)
    unit = quats / quats.norm(dim=-1, keepdim=True)
    w, u = unit[:, :1], unit[:, 1:]
    expected = v + 2 * torch.linalg.cross(u, torch.linalg.cross(u, v) + w * v)
    assert_close((quat_to_rotation(quats) @ v[..., None]).squeeze(-1), expected)


def test_rotation_to_quat_inverts(device, dtype):
    """Half turns about each axis included, where the formula from the trace divides by zero."""
    quats = torch.cat([torch.eye(4).double(), unit(200, 4)]).to(device, dtype)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    back = rotation_to_quat(quat_to_rotation(quats))
    assert (back[:, 0] >= 0).all()
    assert_close(quat_to_rotation(back), quat_to_rotation(quats))
    near(back[4:], quats[4:], 1e-5 if dtype == torch.float32 else 1e-13)


def test_a_product_of_quaternions_is_one_rotation_after_the_other():
    draw = seeded(4)
    first = randn(4, generator=draw)
    second = randn(5, 4, generator=draw)
    both = quat_to_rotation(quat_multiply(first, second))
    assert_close(both, quat_to_rotation(first) @ quat_to_rotation(second))


def test_a_turn_is_the_exponential_of_its_cross_product():
    """Of any size; a small one, and its derivative at zero, are exact."""
    turn = torch.cat([4 * randn(20, 3), torch.zeros(1, 3).double()])
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    near(rotation_of(turn), torch.linalg.matrix_exp(cross), 1e-12)
    assert_close(turn_of(1e-12 * turn), 1e-12 * cross, rtol=1e-9, atol=1e-21)
    assert torch.autograd.gradcheck(turn_of, torch.zeros(1, 3, dtype=torch.float64, requires_grad=True))
