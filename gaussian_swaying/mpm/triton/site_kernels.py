"""The forces on the sites of the ``modes`` formulation, in one kernel for each substep."""

from gaussian_swaying.geometry.linalg_triton import add3, axpy3, cross3, load3, matvec, store3, transpose
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.triton.shared import VARIES, sum_of_forces


@triton.jit(do_not_specialize=VARIES)
def site_forces(
    moved, rest, values, vectors, numbers, out, count, scene_size, scenes, step_offset, FORCES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Forces on sites that turn without strain, as ``Modes._site_state`` places them.

    ``moved`` has two columns, for amplitudes and their rates, and in each scene the displacements and then the turns of
    its sites. ``out`` gets a row of eight for each: the force in the axes of the site, that in space, its resistance.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    scene = index // scene_size
    row = 6 * (index - scene * scene_size) + 12 * scene_size * scene
    shift = load3(moved, 2, row, mask)
    speed = load3(moved, 2, row + 1, mask)
    x, y, z = load3(moved, 2, row + 6 * scene_size, mask)
    square = x * x + y * y + z * z
    angle = tl.sqrt(tl.maximum(square, 1e-12))
    sine = tl.sin(angle) / angle
    half = tl.sin(0.5 * angle) / angle
    cosine = 2.0 * half * half  # (1 - cos a) / a²
    cut = 1.0 - cosine * square
    R = (
        cut + cosine * x * x, cosine * x * y - sine * z, cosine * x * z + sine * y,
        cosine * x * y + sine * z, cut + cosine * y * y, cosine * y * z - sine * x,
        cosine * x * z - sine * y, cosine * y * z + sine * x, cut + cosine * z * z,
    )  # fmt: skip
    bend = cross3((x, y, z), shift)
    start = load3(rest, 1, 3 * index, mask)
    place = add3(start, 1.0, axpy3(0.5, bend, 1.0, shift))
    force, resistance = sum_of_forces(
        FORCES, R, matvec(R, speed), place, index, mask, scene, values, count, vectors, scenes, step_offset, numbers
    )
    store3(out, 1, 8 * index, matvec(transpose(R), force), mask)
    store3(out, 1, 8 * index + 3, force, mask)
    tl.store(out + 8 * index + 6, resistance, mask)
