"""Where numbers in double precision live."""

import pytest
import torch
from pretend_mps import pretended_mps
from torch import nn

from gaussian_swaying._devices import double_home, in_double, move, on_device, sum_in_double


class _Mixed(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("place", torch.ones(3))
        self.register_buffer("clock", torch.zeros((), dtype=torch.float64))


def test_other_devices_keep_what_they_have():
    assert [double_home(name).type for name in ("cpu", "cuda", "mps")] == ["cpu", "cuda", "cpu"]
    values = torch.rand(5, 3)
    assert torch.equal(in_double(values), values.double())
    assert torch.equal(sum_in_double(values, 0), values.sum(0, dtype=torch.float64))
    assert in_double(values.double()).data_ptr() != values.data_ptr()
    module = _Mixed()
    assert move(module, "cpu") is module
    assert module.clock.dtype == torch.float64


def test_double_precision_stays_on_the_cpu_where_the_device_has_none():
    values = torch.rand(5, 3)
    with pretended_mps():
        there = values.to("mps")
        assert there.device.type == "mps"
        for found, expected in (
            (in_double(there), values.double()),
            (sum_in_double(there, 0), values.sum(0, dtype=torch.float64)),
        ):
            assert (found.device.type, found.dtype) == ("cpu", torch.float64)
            assert torch.equal(found, expected)
        assert on_device(values.double(), "mps").device.type == "cpu"
        module = move(_Mixed(), "mps")
        assert (module.place.device.type, module.clock.device.type) == ("mps", "cpu")


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (lambda: torch.zeros(2, device="mps", dtype=torch.float64), "double precision"),
        (lambda: torch.zeros(2, device="mps").double(), "double precision"),
        (lambda: torch.ones(2, device="mps") + torch.ones(2), "both devices"),
        (lambda: torch.linalg.eigvals(torch.ones(2, 2, device="mps")), "no kernel"),
        (lambda: torch.ones(2, device="mps").numpy(), "numpy"),
    ],
)
def test_the_pretended_device_refuses_what_a_mac_would(work, words):
    with pretended_mps(), pytest.raises((NotImplementedError, TypeError, RuntimeError, AssertionError), match=words):
        work()


def test_the_pretended_device_computes_with_gradients():
    with pretended_mps() as mode:
        start = torch.tensor([1.0, 2.0], requires_grad=True)
        layer = nn.Linear(2, 2).to("mps")
        there = start.to("mps")
        (layer(there).sum() + 2.0 * there[1]).backward()
        assert start.grad.device.type == "cpu"
        assert layer.weight.grad.device.type == "mps"
        expected = layer.weight.detach().cpu().sum(0) + torch.tensor([0.0, 2.0])
    torch.testing.assert_close(start.grad, expected)
    assert mode.seen["addmm"] == 1
