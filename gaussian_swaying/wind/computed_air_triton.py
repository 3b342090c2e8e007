"""The force of computed air as a device function; its definition is ``computed_air.AirPush``."""

from gaussian_swaying.kernels.language import tl, triton


@triton.jit
def air_push(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    """``point``: the force at rest (three numbers), and its decrease per velocity."""
    rate = point[3]
    return (
        (point[0] - rate * velocity[0], point[1] - rate * velocity[1], point[2] - rate * velocity[2]),
        rate * 0.0,
    )
