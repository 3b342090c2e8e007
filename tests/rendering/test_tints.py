import torch

from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.rendering.tints import TINTS, by_role, greyed, tinted


def test_roles_are_told_apart_by_their_colours():
    own = torch.tensor([0.2, 0.6, 0.1])
    shown = dict(zip(ROLES, by_role(own.expand(len(ROLES), 3), torch.arange(len(ROLES))), strict=True))
    assert torch.equal(shown["soft"], own)
    torch.testing.assert_close(shown["still"], torch.full((3,), 0.5 + 0.4 * 0.3))
    for role in set(ROLES) - {"soft", "still"}:
        torch.testing.assert_close(shown[role], 0.3 * own + 0.7 * torch.tensor(TINTS[role]) / 255)
    assert len({tuple(colour.tolist()) for colour in shown.values()}) == len(ROLES)


def test_a_tint_is_a_share_of_another_colour():
    own = torch.tensor([[1.0, 0.0, 0.5]])
    torch.testing.assert_close(tinted(own, (0, 255, 0), 0.4), torch.tensor([[0.6, 0.4, 0.3]]))
    torch.testing.assert_close(greyed(own), torch.full((1, 3), 0.7))
