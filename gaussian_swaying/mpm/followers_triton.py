"""One kernel for the fields of Gaussians that follow the nodes, for a picture; the definitions are in ``followers``."""

from gaussian_swaying.geometry.linalg_triton import load3, load9, matmul, store3, transpose
from gaussian_swaying.geometry.patches import deform_and_store
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.triton.shared import VARIES, axis_weights
from gaussian_swaying.mpm.triton.total_kernels import gather


@triton.jit(do_not_specialize=VARIES)
def follow(
    fields, first, table, fraction, arm, axes, means, covariance, normal, solid,
    means_out, covariance_out, normal_out, rotation_out, square, per_metre, count, sx, sy, inverse_dx,
    ARM: tl.constexpr, TURN: tl.constexpr, LIMIT: tl.constexpr, BLOCK: tl.constexpr, VIRTUAL: tl.constexpr,
):  # fmt: skip
    """One Gaussian per lane: its displacement and F from the nodes, in the axes of the scene."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    if VIRTUAL:
        node = tl.minimum(index, count - 1)
    else:
        node = tl.load(first + index, mask, 0)
    f = (
        tl.load(fraction + index, mask, 1.0),
        tl.load(fraction + count + index, mask, 1.0),
        tl.load(fraction + 2 * count + index, mask, 1.0),
    )
    wz, gz = axis_weights(f[2], inverse_dx)
    u, G, _v = gather(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False, table, count, VIRTUAL)
    if ARM:
        a = load3(arm, 1, 3 * index, mask)
        u = (
            u[0] + G[0] * a[0] + G[1] * a[1] + G[2] * a[2],
            u[1] + G[3] * a[0] + G[4] * a[1] + G[5] * a[2],
            u[2] + G[6] * a[0] + G[7] * a[1] + G[8] * a[2],
        )
    zero = 0 * index
    R = load9(axes, 1, zero, mask)
    F = matmul(matmul(transpose(R), G), R)  # zero at rest, so that nothing moves there
    F = (F[0] + 1, F[1], F[2], F[3], F[4] + 1, F[5], F[6], F[7], F[8] + 1)
    x = load3(means, 1, 3 * index, mask)
    x = (
        x[0] + per_metre * (R[0] * u[0] + R[3] * u[1] + R[6] * u[2]),
        x[1] + per_metre * (R[1] * u[0] + R[4] * u[1] + R[7] * u[2]),
        x[2] + per_metre * (R[2] * u[0] + R[5] * u[1] + R[8] * u[2]),
    )
    store3(means_out, 1, 3 * index, x, mask)
    deform_and_store(
        F, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, index, mask, TURN, LIMIT
    )
