"""Numbers in double precision, such as sums over many substeps and places far from the origin."""

from torch import Tensor


def in_double(tensor: Tensor) -> Tensor:
    """A tensor in float64, of the same shape and on its device."""
    return tensor.double()
