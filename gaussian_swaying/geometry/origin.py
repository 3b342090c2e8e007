"""An origin that is taken off places far from zero, such as map coordinates, before they are rounded to float32."""

from __future__ import annotations

import numpy as np

Origin = tuple[float, float, float]
NO_ORIGIN: Origin = (0.0, 0.0, 0.0)
_FAR = 256  # of the extent; float32 has steps of 1.5e-5 of the extent there
_SAMPLE = 1 << 17  # places that are looked at


def counted_from(origin: Origin) -> str:
    """A sentence for users who place something in a scene whose origin was taken off; empty if none was."""
    if not any(origin):
        return ""
    return f"coordinates count from {list(origin)} of the file, as float32 is too coarse so far from zero"


def origin_of(places: np.ndarray) -> Origin:
    """The origin to take off places, in float64, so that float32 can hold them; zero unless they are far away.

    It is near their middle and a multiple of a power of two, so that nothing is rounded where they were float32 before.
    Few places that lie apart from the others do not count, nor do those that are not finite.

    Args:
        places: Shape (N, 3).

    Example:
        >>> places = np.array([[500123.25, 4649776.5, 312.0], [500124.75, 4649777.5, 313.0]])
        >>> origin_of(places)
        (500124.0, 4649777.0, 312.0)
        >>> (places - origin_of(places)).astype(np.float32).tolist()
        [[-0.75, -0.5, 0.0], [0.75, 0.5, 1.0]]
    """
    some = places[:: -(-len(places) // _SAMPLE) or 1].astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return NO_ORIGIN
    low, middle, high = np.quantile(some, (0.05, 0.5, 0.95), axis=0)
    extent = float((high - low).max())
    if not 0 < extent * _FAR < np.abs(middle).max():
        return NO_ORIGIN
    step = 2.0 ** np.floor(np.log2(extent))
    x, y, z = (np.rint(middle / step) * step).tolist()
    return x, y, z
