import pytest
import torch
from shared import randn

from gaussian_swaying.geometry.groups import equal_rows

CASES = {
    "few values": lambda: torch.randint(-3, 3, (500, 4)),
    "booleans": lambda: torch.rand(200, 5) > 0.5,
    "wide": lambda: torch.randint(-(2**62), 2**62, (300, 3))[torch.randint(300, (900,))],
    "half of the range of integers each": lambda: torch.randint(0, 2**31, (300, 4))[torch.randint(300, (900,))],
    "an eighth of the range of integers each": lambda: torch.randint(0, 2**61, (300, 3))[torch.randint(300, (900,))],
    "above int64 with the ranks of the first": lambda: torch.stack(
        [torch.randint(0, 2**k, (300,)) for k in (61, 55)], -1
    )[torch.randint(300, (900,))],
    "the ends of the range of integers": lambda: torch.tensor([[2**63 - 1, 0], [-(2**63), 1], [0, 1], [0, 1]]),
    "floating point": lambda: randn(40, 3)[torch.randint(40, (300,))],
    "signed zeros": lambda: torch.tensor([[0.0, 1.0], [-0.0, 1.0], [-1.0, 0.0]]),
    "one": lambda: torch.zeros(1, 2),
    "none": lambda: torch.zeros(0, 3, dtype=torch.long),
}


@pytest.mark.parametrize("case", CASES)
def test_equal_rows(case):
    torch.manual_seed(0)
    rows = CASES[case]()
    expected = torch.unique(rows, dim=0, return_inverse=True)[1]
    assert torch.equal(equal_rows(rows), expected)
