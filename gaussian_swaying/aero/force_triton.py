"""The force of the wind as a Triton function, for the fused substep. The reference is ``aero.wind_force``."""

import triton
import triton.language as tl

from gaussian_swaying.geometry.linalg_triton import cross3, dot3
from gaussian_swaying.geometry.patches_triton import deform_patch


@triton.jit
def aero_force(
    relative, n, area, drag, friction, lift, half_density,
    PROJECTED: tl.constexpr, LIFT: tl.constexpr, UNIT: tl.constexpr,
):  # fmt: skip
    """Force on a patch in a relative wind, and the relative speed."""
    speed = tl.sqrt(dot3(relative, relative))
    along = dot3(relative, n)
    sign = tl.where(along < 0, -1.0, 1.0)
    tx = relative[0] - along * n[0]
    ty = relative[1] - along * n[1]
    tz = relative[2] - along * n[2]
    if PROJECTED:
        pressure = drag * speed * along  # sign times sign is one
    else:
        pressure = drag * speed * speed * sign
    shear = friction * speed
    if UNIT:
        # normalise first: in a wind along the normal the tangent is zero, and the other order would overflow
        size = tl.maximum(tl.sqrt(tx * tx + ty * ty + tz * tz), 1.2e-38)
        tx = tx / size
        ty = ty / size
        tz = tz / size
        shear = shear * speed
    across = cross3(relative, n)
    if LIFT:
        side = cross3(across, relative)
        lifting = lift * sign
    else:
        side = across
        lifting = lift * speed * sign
    scale = half_density * area
    force = (
        scale * (pressure * n[0] + shear * tx + lifting * side[0]),
        scale * (pressure * n[1] + shear * ty + lifting * side[1]),
        scale * (pressure * n[2] + shear * tz + lifting * side[2]),
    )
    return force, speed


@triton.jit
def wind_force(F, velocity, patch, wind, numbers, OPTIONS: tl.constexpr):
    """Triton twin of ``WindForce``: force on patches (normal and area at rest) and their resistance [kg/s].

    ``numbers``: C_D, C_F, C_L, half the density of the air, largest ratio of areas. ``OPTIONS``: projected law, lift in
    the plane of flow and normal, unit tangent, semi-implicit drag.
    """
    normal, area = deform_patch(F, (patch[0], patch[1], patch[2]), patch[3], tl.load(numbers + 4))
    relative = (
        tl.load(wind) - velocity[0],
        tl.load(wind + 1) - velocity[1],
        tl.load(wind + 2) - velocity[2],
    )
    drag = tl.load(numbers)
    friction = tl.load(numbers + 1)
    lift = tl.load(numbers + 2)
    half_density = tl.load(numbers + 3)
    force, speed = aero_force(
        relative, normal, area, drag, friction, lift, half_density, OPTIONS[0], OPTIONS[1], OPTIONS[2]
    )
    if OPTIONS[3]:
        resistance = half_density * area * (drag + friction + tl.abs(lift)) * speed
    else:
        resistance = area * 0
    return force, resistance
