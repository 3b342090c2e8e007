"""Kernels of :mod:`~gaussian_swaying.rendering.raster`: projection, lists of the Gaussians of each tile, blending.

The definitions are in :mod:`~gaussian_swaying.rendering.torch_renderer`: what is kept and where, the exponent in a row,
the smallest alpha, the end of a pixel. The projection is computed in float64 from numbers in float32, so the pictures
are those of the definition in float64 to float32's rounding of the sums.
"""

from __future__ import annotations

import math

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    clamp,
    dot3,
    load3,
    load9,
    matvec,
    read,
    scale3,
    scale9,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.rendering.protocol import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, SLACK
from gaussian_swaying.rendering.thinning import FEWEST, GOLDEN

WIDTH, HEIGHT = 8, 16
"""Size of a tile [pixels]; a row of it is a vector."""
ROW = 16
"""Numbers of a Gaussian in float32, one cache line: centre x, y and slope in float64, then those below."""
FALLOFF, CURVATURE, PEAK, VALUES, FIRST, LAST = (tl.constexpr(k) for k in (6, 7, 8, 9, 13, 14))
STATE = 5
"""Numbers of a pixel: transmittance (negative once it is full), three colours, depth."""

_MIN, _MAX, _STOP, _SLACK = (tl.constexpr(x) for x in (MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, SLACK))
_LOG_MIN = tl.constexpr(math.log(MIN_ALPHA))
_INFINITE = tl.constexpr(math.inf)
_FEWEST, _GOLDEN = tl.constexpr(FEWEST), tl.constexpr(GOLDEN / 2**32)
_WIDTH, _HEIGHT, _ROW, _STATE = (tl.constexpr(x) for x in (WIDTH, HEIGHT, ROW, STATE))
_LOOK = tl.constexpr(32)  # Gaussians between two looks whether a tile is full


@triton.jit
def _doubles(values):
    found = ()
    for k in tl.static_range(len(values)):
        found = found + (values[k].to(tl.float64),)
    return found


@triton.jit
def _eighth_power(x):
    """(e^x)^8 within 1e-6 for x from -0.7 to 0; positive and at least 1 above."""
    y = 7.95076170e-3 + x * 9.75410199e-4
    y = 4.14846256e-2 + x * y
    y = 1.66621394e-1 + x * y
    y = 4.99994580e-1 + x * y
    y = 9.99999757e-1 + x * y
    y = 1.0 + x * y
    y = y * y
    y = y * y
    return y * y


@triton.jit
def project(
    means, covariances, opacities, colors, camera, rows, wide, depths, boxes, count, width, height, BLOCK: tl.constexpr
):
    """One Gaussian per lane: its row, its depth (infinite if not drawn) and its box of tiles (first and last).

    ``camera`` has its two matrices, near plane, blur and square of the detail, float64; ``wide`` are the rows as
    float64.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    zero = (0 * index).to(tl.float64)
    opacity = tl.load(opacities + index, mask, 0.0)
    color = load3(colors, 1, 3 * index, mask)
    x = _doubles(load3(means, 1, 3 * index, mask))
    C = _doubles(load9(covariances, 1, 9 * index, mask))
    size = tl.abs(opacity).to(tl.float64)
    for k in tl.static_range(3):
        size += tl.abs(color[k]).to(tl.float64) + tl.abs(x[k])
    for k in tl.static_range(9):
        size += tl.abs(C[k])
    right, down, ahead = read(camera, 0, 3), read(camera, 4, 3), read(camera, 8, 3)
    fx, cx = tl.load(camera + 16), tl.load(camera + 18)
    fy, cy = tl.load(camera + 20), tl.load(camera + 21)
    z = dot3(ahead, x) + tl.load(camera + 11)
    keep = mask & (size < _INFINITE) & (z >= tl.load(camera + 25)) & (opacity >= _MIN)
    depth = tl.where(keep, z, 1.0)
    # thinned: some of those smaller than the detail stand for all
    blur = tl.load(camera + 26)
    detail2 = tl.load(camera + 27)
    square = zero
    for k in tl.static_range(9):
        square += C[k] * C[k]
    focal = tl.maximum(fx, fy) / depth
    size2 = tl.sqrt(tl.where(keep, square, 0.0)) * focal * focal
    share = tl.where(detail2 + zero > 0, clamp(size2 / tl.maximum(detail2 + zero, 1e-30), _FEWEST, 1.0), 1.0)
    turns = index.to(tl.float64) * _GOLDEN
    keep = keep & ((turns - tl.floor(turns) < share) | (share >= 1))
    grown = (blur + size2 / share + 1e-30) / (blur + size2 + 1e-30)
    power = (1 / (share * grown)).to(tl.float32)
    covered = 1 - tl.exp(power * tl.log(tl.maximum(1 - tl.where(keep, opacity, 0.0), 1e-7)))
    opacity = tl.where(share < 1, covered, opacity)
    C = scale9(1 / share, C)
    x_ratio = (dot3(right, x) + tl.load(camera + 3)) / depth
    y_ratio = (dot3(down, x) + tl.load(camera + 7)) / depth
    wide_x, wide_y = width.to(tl.float64), height.to(tl.float64)
    x_hat = clamp(x_ratio, (-cx - 0.15 * wide_x) / fx, (1.15 * wide_x - cx) / fx)
    y_hat = clamp(y_ratio, (-cy - 0.15 * wide_y) / fy, (1.15 * wide_y - cy) / fy)
    across = fx / depth
    along = fy / depth
    row_x = scale3(across, add3(right, -x_hat, ahead))
    row_y = scale3(along, add3(down, -y_hat, ahead))
    sigma_x = matvec(C, row_x)
    sigma_y = matvec(C, row_y)
    xx = dot3(row_x, sigma_x) + tl.load(camera + 26)
    xy = dot3(row_x, sigma_y)
    yy = dot3(row_y, sigma_y) + tl.load(camera + 26)
    determinant = xx * yy - xy * xy
    keep = keep & (determinant > 0) & (determinant < _INFINITE) & (yy > 0)
    mean_x = fx * x_ratio + cx
    mean_y = fy * y_ratio + cy
    peak = tl.log(tl.where(keep, opacity, 1.0))
    reach = 2 * tl.maximum(peak - _LOG_MIN, 0.0).to(tl.float64)
    half_x = tl.sqrt(tl.where(keep, reach * xx, 0.0)) + _SLACK
    half_y = tl.sqrt(tl.where(keep, reach * yy, 0.0)) + _SLACK
    left = clamp(-tl.floor(half_x - mean_x + 0.5), 0.0, wide_x)
    last_x = clamp(tl.floor(mean_x - 0.5 + half_x), -1.0, wide_x - 1)
    top = clamp(-tl.floor(half_y - mean_y + 0.5), 0.0, wide_y)
    last_y = clamp(tl.floor(mean_y - 0.5 + half_y), -1.0, wide_y - 1)
    keep = keep & (left <= last_x) & (top <= last_y)
    tl.store(depths + index, tl.where(keep, z, _INFINITE), mask)
    box = boxes + 4 * index
    tl.store(box, tl.where(keep, left.to(tl.int32) // _WIDTH, 0), mask)
    tl.store(box + 1, tl.where(keep, last_x.to(tl.int32) // _WIDTH, -1), mask)
    tl.store(box + 2, tl.where(keep, top.to(tl.int32) // _HEIGHT, 0), mask)
    tl.store(box + 3, tl.where(keep, last_y.to(tl.int32) // _HEIGHT, -1), mask)
    to = wide + index * (_ROW // 2)
    tl.store(to, mean_x, keep)
    tl.store(to + 1, mean_y, keep)
    tl.store(to + 2, xy / yy, keep)
    to = rows + index * _ROW
    tl.store(to + FALLOFF, (0.0625 / yy).to(tl.float32), keep)
    tl.store(to + CURVATURE, (0.0625 * yy / determinant).to(tl.float32), keep)
    tl.store(to + PEAK, peak * 0.125, keep)
    for k in tl.static_range(3):
        tl.store(to + VALUES + k, color[k], keep)
    tl.store(to + VALUES + 3, z.to(tl.float32), keep)
    tl.store(to + FIRST, top.to(tl.float32), keep)
    tl.store(to + LAST, last_y.to(tl.float32), keep)


@triton.jit
def count_pairs(order, boxes, counts, count, across, tiles):
    """One chunk of Gaussians per program: how many of them each tile gets; ``counts`` (chunks, tiles) starts at 0."""
    chunk = tl.program_id(0)
    chunks = tl.num_programs(0)
    own = counts + chunk * tiles
    for p in range(chunk * count // chunks, (chunk + 1) * count // chunks):
        box = boxes + 4 * tl.load(order + p)
        left, right = tl.load(box), tl.load(box + 1)
        for y in range(tl.load(box + 2), tl.load(box + 3) + 1):
            for tile in range(y * across + left, y * across + right + 1):
                tl.store(own + tile, tl.load(own + tile) + 1)


@triton.jit
def list_pairs(order, boxes, starts, pairs, count, across, tiles):
    """As :func:`count_pairs`, but writes the Gaussians of each tile from ``starts`` (chunks, tiles) on."""
    chunk = tl.program_id(0)
    chunks = tl.num_programs(0)
    own = starts + chunk * tiles
    for p in range(chunk * count // chunks, (chunk + 1) * count // chunks):
        gaussian = tl.load(order + p)
        box = boxes + 4 * gaussian
        left, right = tl.load(box), tl.load(box + 1)
        for y in range(tl.load(box + 2), tl.load(box + 3) + 1):
            for tile in range(y * across + left, y * across + right + 1):
                place = tl.load(own + tile)
                tl.store(pairs + place, gaussian.to(tl.int32))
                tl.store(own + tile, place + 1)


@triton.jit
def blend(
    bounds, pairs, rows, wide, states, background, color, alpha, depth, across, tiles, width, height, LANE: tl.constexpr
):
    """Some tiles per program: blend the Gaussians of each from front to back, and write its pixels.

    ``bounds`` are the first pair of each tile and the number of pairs; ``states`` holds the pixels of one tile for each
    program.
    """
    lane = tl.arange(0, LANE)
    pixels = states + tl.program_id(0) * (_HEIGHT * _WIDTH * _STATE)
    for tile in range(tl.program_id(0), tiles, tl.num_programs(0)):
        x0 = (tile % across) * _WIDTH
        y0 = (tile // across) * _HEIGHT
        inside = x0 + lane < width
        for k in range(0, _HEIGHT):
            state = pixels + k * (_WIDTH * _STATE)
            tl.store(state + lane, tl.where(inside & (y0 + k < height), 1.0, -1.0))
            for c in tl.static_range(1, _STATE):
                tl.store(state + c * _WIDTH + lane, tl.zeros([LANE], tl.float32))
        pair = tl.load(bounds + tile)
        end = tl.load(bounds + tile + 1)
        while pair < end:
            stop = tl.minimum(pair + _LOOK, end)
            for p in range(pair, stop):
                gaussian = tl.load(pairs + p)
                line = wide + gaussian * (_ROW // 2)
                row = rows + gaussian * _ROW
                slope = tl.load(line + 2)
                above = y0.to(tl.float64) + 0.5 - tl.load(line + 1)
                middle = (tl.load(line) + slope * above - 0.5 - x0.to(tl.float64)).to(tl.float32)
                slant = slope.to(tl.float32)
                dy = above.to(tl.float32)
                falloff = tl.load(row + FALLOFF)
                curvature = tl.load(row + CURVATURE)
                highest = tl.load(row + PEAK)
                red = tl.load(row + VALUES)
                green = tl.load(row + VALUES + 1)
                blue = tl.load(row + VALUES + 2)
                z = tl.load(row + VALUES + 3)
                first = tl.maximum(tl.load(row + FIRST).to(tl.int32) - y0, 0)
                last = tl.minimum(tl.load(row + LAST).to(tl.int32) - y0, _HEIGHT - 1)
                for k in range(first, last + 1):
                    rise = dy + k.to(tl.float32)
                    u = lane.to(tl.float32) - (middle + slant * k.to(tl.float32))
                    exponent = (highest - falloff * rise * rise) - curvature * u * u
                    state = pixels + k * (_WIDTH * _STATE)
                    T = tl.load(state + lane)
                    near = (exponent > _LOG_MIN / 8 - 1e-4) & (T > 0)
                    if tl.sum(near.to(tl.int32)) > 0:
                        opaque = tl.minimum(_eighth_power(exponent), _MAX)
                        seen = near & (opaque >= _MIN)
                        left = T * (1 - opaque)
                        go = seen & (left > _STOP)
                        weight = tl.where(go, T * opaque, 0.0)
                        tl.store(state + lane, tl.where(go, left, tl.where(seen, -T, T)))
                        to = state + _WIDTH + lane
                        tl.store(to, tl.load(to) + weight * red)
                        tl.store(to + _WIDTH, tl.load(to + _WIDTH) + weight * green)
                        tl.store(to + 2 * _WIDTH, tl.load(to + 2 * _WIDTH) + weight * blue)
                        tl.store(to + 3 * _WIDTH, tl.load(to + 3 * _WIDTH) + weight * z)
            most = tl.full([LANE], -1.0, tl.float32)
            for k in range(0, _HEIGHT):
                most = tl.maximum(most, tl.load(pixels + k * (_WIDTH * _STATE) + lane))
            pair = tl.where(tl.max(most) > 0, stop, end)
        for k in range(0, tl.minimum(_HEIGHT, height - y0)):
            state = pixels + k * (_WIDTH * _STATE)
            at = (y0 + k) * width + x0 + lane
            rest = tl.abs(tl.load(state + lane))
            tl.store(alpha + at, 1 - rest, inside)
            tl.store(depth + at, tl.load(state + 4 * _WIDTH + lane), inside)
            for c in tl.static_range(3):
                value = tl.load(state + (c + 1) * _WIDTH + lane) + rest * tl.load(background + c)
                tl.store(color + 3 * at + c, value, inside)
