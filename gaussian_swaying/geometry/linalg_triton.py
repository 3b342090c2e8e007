"""3x3 matrices as Triton functions, one particle per lane.

The definitions are in :mod:`~gaussian_swaying.geometry.linalg`.

A matrix is a tuple of nine values, row by row; a vector one of three.
"""

from gaussian_swaying.kernels.language import ON_GPU, tl, triton

TINY = tl.constexpr(1e-30)
GPU = tl.constexpr(ON_GPU)


@triton.jit
def load3(pointer, stride, index, mask):
    """Three values, ``stride`` apart, from ``index`` on."""
    return (
        tl.load(pointer + index, mask, 0.0),
        tl.load(pointer + stride + index, mask, 0.0),
        tl.load(pointer + 2 * stride + index, mask, 0.0),
    )


@triton.jit
def store3(pointer, stride, index, value, mask):
    """The counterpart of :func:`load3`."""
    for k in tl.static_range(3):
        tl.store(pointer + k * stride + index, value[k], mask)


@triton.jit
def load9(pointer, stride, index, mask):
    """Nine values, ``stride`` apart, from ``index`` on."""
    found = ()
    for k in tl.static_range(9):
        found = found + (tl.load(pointer + k * stride + index, mask, 0.0),)
    return found


@triton.jit
def read(pointer, FIRST: tl.constexpr, COUNT: tl.constexpr):
    """COUNT numbers in a row from number FIRST on, as a tuple."""
    found = ()
    for k in tl.static_range(COUNT):
        found = found + (tl.load(pointer + FIRST + k),)
    return found


@triton.jit
def chosen(values, FIRST: tl.constexpr, COUNT: tl.constexpr):
    """COUNT values of a tuple from number FIRST on."""
    found = ()
    for k in tl.static_range(COUNT):
        found = found + (values[FIRST + k],)
    return found


@triton.jit
def store9(pointer, stride, index, value, mask):
    """The counterpart of :func:`load9`."""
    for k in tl.static_range(9):
        tl.store(pointer + k * stride + index, value[k], mask)


@triton.jit
def rows(a):
    """The three rows of a matrix."""
    return chosen(a, 0, 3), chosen(a, 3, 3), chosen(a, 6, 3)


@triton.jit
def matmul(a, b):
    """A B."""
    x, y, z = rows(transpose(b))
    return columns9(matvec(a, x), matvec(a, y), matvec(a, z))


@triton.jit
def transpose(a):
    """The transpose."""
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@triton.jit
def matvec(m, x):
    """A matrix times a vector."""
    a, b, c = rows(m)
    return dot3(a, x), dot3(b, x), dot3(c, x)


@triton.jit
def outer3(a, b):
    """A b^T of two vectors."""
    return scale3(a[0], b) + scale3(a[1], b) + scale3(a[2], b)


@triton.jit
def cofactor(a):
    """The cofactor matrix."""
    x, y, z = rows(a)
    return cross3(y, z) + cross3(z, x) + cross3(x, y)


@triton.jit
def dot9(a, b):
    """Sum of the products of the entries of two matrices."""
    found = a[0] * b[0]
    for k in tl.static_range(1, 9):
        found = found + a[k] * b[k]
    return found


@triton.jit
def dot3(a, b):
    """Product of two vectors; of the first rows of a matrix and of its cofactor matrix, the determinant."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross3(a, b):
    """Cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@triton.jit
def rotation(turn):
    """The rotation by an axis times angle [rad]."""
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = tl.sqrt(tl.maximum(square, 1e-12))
    sine = tl.sin(angle) / angle
    half = tl.sin(0.5 * angle) / angle
    cosine = 2.0 * half * half  # (1 - cos a) / a²
    cut = 1.0 - cosine * square
    return (
        cut + cosine * x * x, cosine * x * y - sine * z, cosine * x * z + sine * y,
        cosine * x * y + sine * z, cut + cosine * y * y, cosine * y * z - sine * x,
        cosine * x * z - sine * y, cosine * y * z + sine * x, cut + cosine * z * z,
    )  # fmt: skip


@triton.jit
def scale3(s, a):
    """S a."""
    return s * a[0], s * a[1], s * a[2]


@triton.jit
def scale9(s, a):
    """S A."""
    found = ()
    for k in tl.static_range(9):
        found = found + (s * a[k],)
    return found


@triton.jit
def axpy9(s, a, t, b):
    """S A + t B."""
    found = ()
    for k in tl.static_range(9):
        found = found + (s * a[k] + t * b[k],)
    return found


@triton.jit
def axpy3(s, a, t, b):
    """S a + t b for vectors."""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@triton.jit
def add3(a, t, b):
    """A + t b for vectors."""
    return (a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2])


@triton.jit
def plus_identity(G):
    """I + G, the deformation gradient of a gradient of displacements."""
    return (G[0] + 1, G[1], G[2], G[3], G[4] + 1, G[5], G[6], G[7], G[8] + 1)


@triton.jit
def columns9(a, b, c):
    """The matrix of three columns."""
    return transpose(a + b + c)


@triton.jit
def where3(condition, a, b):
    """Choose between vectors."""
    return (tl.where(condition, a[0], b[0]), tl.where(condition, a[1], b[1]), tl.where(condition, a[2], b[2]))


@triton.jit
def where9(condition, a, b):
    """Choose between matrices."""
    found = ()
    for k in tl.static_range(9):
        found = found + (tl.where(condition, a[k], b[k]),)
    return found


@triton.jit
def scaled_product(u, d, v):
    """U diag(d) V^T."""
    scaled = ()
    for k in tl.static_range(9):
        scaled = scaled + (u[k] * d[k % 3],)
    return matmul(scaled, transpose(v))


@triton.jit
def polar_step(x):
    """A step of Newton's iteration with Higham's scaling."""
    cof = cofactor(x)
    det = dot3(x, cof)
    size = tl.maximum(tl.abs(det), 1e-9)
    inverse = 1.0 / tl.where(det < 0, -size, size)
    ratio = dot9(cof, cof) * inverse * inverse / tl.maximum(dot9(x, x), 1e-9)
    zeta = tl.sqrt(tl.sqrt(tl.maximum(ratio, 1e-37)))
    return axpy9(0.5 * zeta, x, 0.5 * inverse / zeta, cof)


@triton.jit
def polar_rotation(F):
    """The nearest rotation, see ``linalg.polar_rotation``."""
    x = F
    if GPU:
        for _ in range(5):
            x = polar_step(x)
    else:
        settled = 1e-16 if x[0].dtype == tl.float64 else 1e-8  # then the next change is below epsilon
        k = 0
        while k < 5:
            last = x
            x = polar_step(x)
            change = axpy9(1.0, x, -1.0, last)
            k = tl.where(tl.max(dot9(change, change)) > settled, k + 1, 5)  # changes square
    cof = cofactor(x)
    reflected = dot3(x, cof) < 0
    if tl.max(reflected.to(tl.int32)) > 0:
        u, _a, v = svd3(F)
        x = where9(reflected, matmul(u, transpose(v)), x)
    return x


@triton.jit
def polar_change(F, R, x):
    """Derivative of the nearest rotation R in a direction X, as that of ``linalg.polar_rotation``; symmetric in X."""
    s = matmul(transpose(R), F)
    trace = s[0] + s[4] + s[8]
    m01 = -0.5 * (s[1] + s[3])
    m02 = -0.5 * (s[2] + s[6])
    m12 = -0.5 * (s[5] + s[7])
    system = (trace - s[0], m01, m02, m01, trace - s[4], m12, m02, m12, trace - s[8])
    cof = cofactor(system)
    size = tl.maximum(tl.abs(system[0]), tl.maximum(tl.abs(system[4]), tl.abs(system[8])))
    size = tl.maximum(size, tl.maximum(tl.abs(m01), tl.maximum(tl.abs(m02), tl.abs(m12))))
    least = 3.4526698e-4 * tl.maximum(size * size * size, 1.0842022e-19)
    scale = 1.0 / tl.maximum(dot3(system, cof), least)
    turn = matmul(transpose(R), x)
    k = (turn[7] - turn[5], turn[2] - turn[6], turn[3] - turn[1])
    spin = scale3(scale, matvec(cof, k))
    a, b, c = rows(R)
    return cross3(a, spin) + cross3(b, spin) + cross3(c, spin)


@triton.jit
def _angle(app, aqq, apq):
    gap = aqq - app
    twice = 2 * apq
    root = tl.maximum(tl.sqrt(gap * gap + twice * twice), tl.abs(twice)) + TINY
    tangent = tl.where(gap < 0, -twice, twice) / (tl.abs(gap) + root)
    cosine = 1.0 / tl.sqrt(1 + tangent * tangent)
    return tangent, cosine, cosine * tangent


@triton.jit
def _turn(c, s, a, b):
    return axpy3(c, a, -s, b), axpy3(s, a, c, b)


@triton.jit
def _one_sided(bp, bq, vp, vq):
    _t, c, s = _angle(dot3(bp, bp), dot3(bq, bq), dot3(bp, bq))
    bp, bq = _turn(c, s, bp, bq)
    vp, vq = _turn(c, s, vp, vq)
    return bp, bq, vp, vq


@triton.jit
def _ordered(bp, bq, vp, vq):
    """The longer of two columns first; a swap turns one round."""
    swap = dot3(bp, bp) < dot3(bq, bq)
    return (
        where3(swap, bq, bp),
        where3(swap, scale3(-1.0, bp), bq),
        where3(swap, vq, vp),
        where3(swap, scale3(-1.0, vp), vq),
    )


@triton.jit
def _unit(vector, fallback):
    squared = dot3(vector, vector)
    scale = 1.0 / tl.sqrt(tl.maximum(squared, 1e-31))
    return where3(squared > 1e-31, scale3(scale, vector), fallback)


@triton.jit
def svd3(F):
    """U, signed stretches and V of F = U diag(a) V^T, U and V rotations, as ``linalg.spectrum``."""
    c0, c1, c2 = rows(transpose(F))
    a00 = dot3(c0, c0)
    a11 = dot3(c1, c1)
    a22 = dot3(c2, c2)
    a01 = dot3(c0, c1)
    a02 = dot3(c0, c2)
    a12 = dot3(c1, c2)
    zero = F[0] * 0
    v0 = (zero + 1, zero, zero)
    v1 = (zero, zero + 1, zero)
    v2 = (zero, zero, zero + 1)
    for _ in range(4):
        t, c, s = _angle(a00, a11, a01)
        shift = t * a01
        a00, a11, a01 = a00 - shift, a11 + shift, zero
        a02, a12 = c * a02 - s * a12, s * a02 + c * a12
        v0, v1 = _turn(c, s, v0, v1)
        t, c, s = _angle(a00, a22, a02)
        shift = t * a02
        a00, a22, a02 = a00 - shift, a22 + shift, zero
        a01, a12 = c * a01 - s * a12, s * a01 + c * a12
        v0, v2 = _turn(c, s, v0, v2)
        t, c, s = _angle(a11, a22, a12)
        shift = t * a12
        a11, a22, a12 = a11 - shift, a22 + shift, zero
        a01, a02 = c * a01 - s * a02, s * a01 + c * a02
        v1, v2 = _turn(c, s, v1, v2)
    b0 = matvec(F, v0)
    b1 = matvec(F, v1)
    b2 = matvec(F, v2)
    for _ in range(2):
        b0, b1, v0, v1 = _one_sided(b0, b1, v0, v1)
        b0, b2, v0, v2 = _one_sided(b0, b2, v0, v2)
        b1, b2, v1, v2 = _one_sided(b1, b2, v1, v2)
    b0, b1, v0, v1 = _ordered(b0, b1, v0, v1)
    b0, b2, v0, v2 = _ordered(b0, b2, v0, v2)
    b1, b2, v1, v2 = _ordered(b1, b2, v1, v2)
    first = _unit(b0, v0)
    component = tl.where(tl.abs(first[0]) < 0.8, 1.0, 0.0)
    other = _reject((component, 1 - component, zero), first)
    second = _unit(_reject(b1, first), _unit(other, other))
    second = _unit(_reject(second, first), second)
    third = cross3(first, second)
    stretch = (dot3(first, b0), dot3(second, b1), dot3(third, b2))
    return columns9(first, second, third), stretch, columns9(v0, v1, v2)


@triton.jit
def _reject(a, unit):
    return add3(a, -dot3(a, unit), unit)


@triton.jit
def clamp(x, low, high):
    """X between two limits."""
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def largest(x, y):
    """The larger of two numbers; NaN if one is."""
    return tl.maximum(x, y, tl.PropagateNan.ALL)


@triton.jit
def largest_eigenvalue(m):
    """Largest eigenvalue of a symmetric matrix, in closed form (Smith 1961)."""
    mean = (m[0] + m[4] + m[8]) / 3
    d = (m[0] - mean, m[1], m[2], m[3], m[4] - mean, m[5], m[6], m[7], m[8] - mean)
    radius = tl.sqrt(dot9(d, d) / 6)
    cof = cofactor(d)
    scale = 1.0 / tl.maximum(radius, 1e-19)
    half = 0.5 * dot3(d, cof) * scale * scale * scale
    # 2 cos(acos(h) / 3) = 1 + e with e² (3 + e) = 2 (1 + h): Newton from above, good to round-off at a double root too
    target = 2 * (1 + clamp(half, -1.0, 1.0))
    e = tl.sqrt(target / 3)
    for _ in range(4):
        e = e - (e * e * (3 + e) - target) / tl.maximum(e * (6 + 3 * e), 1e-30)
    return mean + radius * (1 + e)
