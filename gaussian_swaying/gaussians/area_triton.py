"""The cells of ``area.coverage_area`` in one kernel, compiled for a CPU; the definition is ``area._cell_area``."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import add3, cross3, dot3, load3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch


@triton.jit
def _cells(
    offset, distance, normal, disc, discs, ray, open_cosine, flat, reach, cosine, repeat, same, out, count,
    K: tl.constexpr, RAYS: tl.constexpr, CLUSTER: tl.constexpr, CELL: tl.constexpr, SLAB: tl.constexpr,
    SPIKE: tl.constexpr, REACH: tl.constexpr, PI: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < count
    farthest = tl.load(distance + (K - 1) * count + lane, mask, 1.0)
    close = CLUSTER * farthest
    zero = 0 * farthest
    alone = zero
    for a in range(K):
        p = load3(offset, K * count, a * count + lane, mask)
        again = tl.where(tl.load(distance + a * count + lane, mask, 0.0) < close, 1.0, zero)
        for b in range(a):
            gap = add3(p, -1.0, load3(offset, K * count, b * count + lane, mask))
            again = tl.where(tl.sqrt(dot3(gap, gap)) < close, 1.0, again)
        tl.store(repeat + a * count + lane, again, mask)
        alone += 1 - again
    spacing = farthest * tl.sqrt(PI / tl.maximum(alone, 1.0))

    # two axes in the plane of the site
    n = load3(normal, count, lane, mask)
    least_x = (tl.abs(n[0]) <= tl.abs(n[1])) & (tl.abs(n[0]) <= tl.abs(n[2]))
    least_y = tl.abs(n[1]) <= tl.abs(n[2])
    u = (
        tl.where(least_x, zero, tl.where(least_y, n[2], -n[1])),
        tl.where(least_x, -n[2], tl.where(least_y, zero, n[0])),
        tl.where(least_x, n[1], tl.where(least_y, -n[0], zero)),
    )
    length = tl.maximum(tl.sqrt(dot3(u, u)), 1e-12)
    u = (u[0] / length, u[1] / length, u[2] / length)
    v = cross3(n, u)

    own = tl.load(disc + lane, mask, 1.0)
    found = zero
    fresh = zero
    stacks = zero
    around = own
    for a in range(K):
        p = load3(offset, K * count, a * count + lane, mask)
        first = dot3(p, u)
        second = dot3(p, v)
        sheet = tl.abs(dot3(p, n)) <= SLAB * spacing
        stacked = sheet & (first * first + second * second <= 1e-12 * (spacing * spacing))
        beside = tl.where(stacked, zero, tl.where(sheet, 1.0, zero))
        tl.store(flat + a * count + lane, first, mask)
        tl.store(flat + (K + a) * count + lane, second, mask)
        tl.store(flat + (2 * K + a) * count + lane, beside, mask)
        tl.store(same + a * count + lane, tl.where(sheet, 1, 0).to(tl.int8), mask)
        found += beside
        stacks += tl.where(stacked, 1.0, zero)
        fresh += beside * (1 - tl.load(repeat + a * count + lane, mask, 1.0))
        around += beside * tl.load(discs + a * count + lane, mask, 0.0)
    limit = tl.minimum(SPIKE * spacing, REACH * tl.sqrt(around / (PI * (1 + found))))
    open_from = tl.load(open_cosine + fresh.to(tl.int32), mask, 0.0)

    for r in range(RAYS):
        rx = tl.load(ray + r * count + lane, mask, 1.0)
        ry = tl.load(ray + (RAYS + r) * count + lane, mask, 0.0)
        far = zero + float("inf")
        near = zero - 1
        for a in range(K):
            first = tl.load(flat + a * count + lane, mask, 0.0)
            second = tl.load(flat + (K + a) * count + lane, mask, 0.0)
            beside = tl.load(flat + (2 * K + a) * count + lane, mask, 0.0) > 0
            square = first * first + second * second
            along = rx * first + ry * second
            ahead = beside & (along > 0)
            far = tl.where(ahead, tl.minimum(far, 0.5 * square / tl.where(ahead, along, 1.0)), far)
            cos = along / tl.maximum(tl.sqrt(square), 1e-300)
            near = tl.where(beside, tl.maximum(near, cos), near)
        tl.store(reach + r * count + lane, far, mask)
        tl.store(cosine + r * count + lane, near, mask)

    size = tl.sqrt(own / PI)
    for _ in range(3):
        lowest = zero + 2
        widest = (0 * lane).to(tl.int32)
        for r in range(RAYS):
            near = tl.load(cosine + r * count + lane, mask, 1.0)
            widest = tl.where(near < lowest, r, widest)
            lowest = tl.minimum(near, lowest)
        opposite = tl.load(reach + ((widest + RAYS // 2) % RAYS) * count + lane, mask, 1.0)
        edge = tl.where(opposite > limit, size, opposite)
        wx = tl.load(ray + widest * count + lane, mask, 1.0)
        wy = tl.load(ray + (RAYS + widest) * count + lane, mask, 0.0)
        for r in range(RAYS):
            rx = tl.load(ray + r * count + lane, mask, 1.0)
            ry = tl.load(ray + (RAYS + r) * count + lane, mask, 0.0)
            toward = rx * wx + ry * wy
            far = tl.load(reach + r * count + lane, mask, 1.0)
            cut = (lowest < open_from) & (toward > 1e-6)
            far = tl.where(cut, tl.minimum(far, edge / tl.maximum(toward, 1e-6)), far)
            tl.store(reach + r * count + lane, far, mask)
            near = tl.load(cosine + r * count + lane, mask, 1.0)
            tl.store(cosine + r * count + lane, tl.where(toward > 0.5, 1.0, near), mask)
    total = zero
    for r in range(RAYS):
        far = tl.minimum(tl.load(reach + r * count + lane, mask, 0.0), limit)
        total += far * far
    within = zero
    for a in range(K):
        first = tl.load(flat + a * count + lane, mask, 0.0)
        second = tl.load(flat + (K + a) * count + lane, mask, 0.0)
        beside = tl.load(flat + (2 * K + a) * count + lane, mask, 0.0)
        within += tl.where(tl.sqrt(first * first + second * second) < 2 * limit, beside, zero)
    tl.store(out + lane, tl.where(within < 3, own, total * CELL) / (1 + stacks), mask)


def cells(
    offset: Tensor,
    distance: Tensor,
    normal: Tensor,
    disc: Tensor,
    discs: Tensor,
    ray: Tensor,
    open_cosine: Tensor,
    cluster: float,
    slab: float,
    spike: float,
    reach: float,
) -> tuple[Tensor, Tensor]:
    """Areas of cells and which neighbours are on the same sheet; float64.

    Args:
        offset: From each site to its neighbours, shape (B, k, 3).
        distance: Their lengths, ascending, shape (B, k).
        normal: Unit normals, shape (B, 3).
        disc: Areas of the sites alone, shape (B,).
        discs: Those of the neighbours, shape (B, k).
        ray: Directions in the plane of each site, shape (B, rays, 2).
        open_cosine: Cosine below which a direction is open, for each number of neighbours, shape (k + 1,).
        cluster: Centres closer than this share of the distance to the last neighbour count as one.

    Returns:
        Shapes (B,) and (B, k), bool.
    """
    count, neighbours = distance.shape
    rays = ray.shape[1]
    across = [t.movedim(0, -1).contiguous() for t in (offset.movedim(-1, 1), distance, normal)]
    scratch = [distance.new_empty(rows, count) for rows in (3 * neighbours, rays, rays, neighbours)]
    same = torch.empty(neighbours, count, dtype=torch.int8)
    out = torch.empty_like(disc)
    block = lanes(out.device, 64)
    launch(_cells, (triton.cdiv(count, block),))(
        *across, disc.contiguous(), discs.mT.contiguous(), ray.permute(2, 1, 0).contiguous(), open_cosine, *scratch,
        same, out, count, K=neighbours, RAYS=rays, CLUSTER=cluster, CELL=torch.pi / rays, SLAB=slab, SPIKE=spike,
        REACH=reach, PI=torch.pi, BLOCK=block,
    )  # fmt: skip
    return out, same.mT.bool()
