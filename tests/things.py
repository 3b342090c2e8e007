"""Things of a few tubes, balls and blocks, as splats and as captures of them: surfaces only, z up, in metres."""

import dataclasses
import math

import torch
from shared import unit
from small_scenes import GREEN, coloured, plain_cloud, together, turned_cloud

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.scenes.alocasia import alocasia
from gaussian_swaying.scenes.ficus import ficus

AWAY = (3.0, 4.0, 5.0)
"""An origin far from a thing says nothing about its ends."""
GREY, SKIN, BLUE = (0.5,) * 3, (0.8, 0.6, 0.45), (0.2, 0.25, 0.6)


def draws(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def tube(low, high, radius, count=600, end=None, seed=0):
    draw = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(low), torch.tensor(high)
    axis = torch.nn.functional.normalize(high - low, dim=0)
    first = torch.linalg.cross(axis, torch.eye(3)[int(axis.abs().argmin())])
    first = torch.nn.functional.normalize(first, dim=0)
    second = torch.linalg.cross(axis, first)
    share, angle = torch.rand(count, generator=draw), 2 * math.pi * torch.rand(count, generator=draw)
    inner = torch.ones(count)
    caps = count // 5
    share[:caps] = torch.arange(caps) % 2
    inner[:caps] = torch.rand(caps, generator=draw).sqrt()
    reach = inner * (radius + share * ((radius if end is None else end) - radius))
    ring = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    return low + share[:, None] * (high - low) + reach[:, None] * ring


def ball(center, radius, count=600, seed=0):
    draw = torch.Generator().manual_seed(seed)
    return torch.tensor(center) + radius * unit(count, 3, generator=draw, dtype=torch.float32)


def block(low, high, count=1500, seed=0):
    place, side = draws(count, 3, seed=seed), torch.arange(count) % 3
    place[torch.arange(count), side] = (torch.arange(count) // 3 % 2).float()
    low, high = torch.tensor(low), torch.tensor(high)
    return low + place * (high - low)


def full(low, high, count=1500, seed=0):
    low, high = torch.tensor(low), torch.tensor(high)
    return low + (high - low) * draws(count, 3, seed=seed)


def splat(*parts, move=(0.0, 0.0, 0.0)):
    """Points as round, opaque Gaussians."""
    return plain_cloud(torch.cat(parts) + torch.tensor(move), math.log(0.02), logit=2.0)


def painted(means, color, scales=-4.0):
    return coloured(plain_cloud(means, scales), color)


def man():
    """1.8 high, in a stride, with a torso wider than the legs, a neck and a head, the origin between the feet."""
    return [
        block([0.05, -0.05, 0.0], [0.17, 0.25, 0.08]),
        block([-0.17, -0.3, 0.0], [-0.05, 0.0, 0.08]),
        tube([0.11, 0.05, 0.0], [0.1, 0.0, 0.9], 0.07),
        tube([-0.11, -0.2, 0.0], [-0.1, 0.0, 0.9], 0.07),
        tube([0.0, 0.0, 0.85], [0.0, 0.0, 1.5], 0.2, 1200),
        tube([0.25, 0.0, 0.85], [0.25, 0.0, 1.45], 0.05),
        tube([-0.25, 0.0, 0.85], [-0.25, 0.0, 1.45], 0.05),
        tube([0.0, 0.0, 1.45], [0.0, 0.0, 1.6], 0.06, 200),
        ball([0.0, 0.0, 1.68], 0.12),
    ]


def biker():
    return [
        *(tube([x, -0.02, 0.33], [x, 0.02, 0.33], 0.33, 1500) for x in (-0.5, 0.5)),
        tube([-0.5, 0.0, 0.33], [-0.15, 0.0, 0.8], 0.03, 400),
        tube([-0.15, 0.0, 0.8], [0.35, 0.0, 0.85], 0.03, 400),
        tube([0.35, 0.0, 0.9], [0.5, 0.0, 0.33], 0.03, 400),
        tube([-0.15, 0.0, 0.85], [0.2, 0.0, 1.4], 0.16, 2000, 0.2),
        *(tube([-0.1, y, 0.85], [0.05, y, 0.3], 0.07, 700) for y in (-0.12, 0.12)),
        *(tube([0.2, y, 1.35], [0.4, y, 0.95], 0.05, 500) for y in (-0.2, 0.2)),
        ball([0.32, 0.0, 1.55], 0.12),
    ]


def guitar_on_a_stand():
    """1 high: a stand of three feet, a body and a long thin neck with a head, which lean back."""
    return [
        tube([0.0, 0.12, 0.35], [-0.18, -0.15, 0.0], 0.015, 300),
        tube([0.0, 0.12, 0.35], [0.18, -0.15, 0.0], 0.015, 300),
        tube([0.0, 0.12, 0.35], [0.0, 0.22, 0.0], 0.015, 300),
        tube([0.0, -0.06, 0.08], [0.0, 0.02, 0.48], 0.16, 2500, 0.1),
        tube([0.0, 0.02, 0.48], [0.0, 0.13, 0.9], 0.018, 800),
        block([-0.04, 0.12, 0.9], [0.04, 0.15, 1.0], 300),
    ]


def plant_in_a_pot():
    return [
        tube([0.0, 0.0, 0.0], [0.0, 0.0, 0.2], 0.1, 900, 0.14),
        tube([0.0, 0.0, 0.18], [0.0, 0.0, 0.6], 0.015, 400),
        ball([0.0, 0.0, 0.7], 0.25, 1500),
    ]


def lamp(shade="bulb"):
    """A bulb or a conical shade on a cord 0.6 long, under a small plate at the ceiling."""
    body = ball([0.0, 0.0, 0.12], 0.12, 1200)
    if shade == "cone":
        body = tube([0.0, 0.0, 0.0], [0.0, 0.0, 0.25], 0.25, 1500, 0.03)
    return [
        body,
        tube([0.0, 0.0, 0.2], [0.0, 0.0, 0.9], 0.006, 600),
        tube([0.0, 0.0, 0.88], [0.0, 0.0, 0.92], 0.04, 300),
    ]


def figure(head, clothes=BLUE):
    """A head on shoulders on legs, 1.75 m high."""
    return together(
        painted(full([-0.1, -0.1, 1.45], [0.1, 0.1, 1.75], 600), head),
        painted(full([-0.25, -0.12, 0.8], [0.25, 0.12, 1.45], 2500, 1), clothes),
        painted(full([-0.2, -0.1, 0.0], [0.2, 0.1, 0.8], 2500, 2), clothes),
    )


def cone():
    z = 1 - draws(6000).sqrt()
    angle, radius = 2 * math.pi * draws(6000, seed=1), 0.35 * (1 - z)
    return painted(torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1), GREEN)


def tuft():
    blade, share = (80 * draws(6000)).long(), draws(6000, seed=1)
    angle, lean = 2 * math.pi * draws(80, seed=2)[blade], 0.15 + 0.25 * draws(80, seed=3)[blade]
    out = 0.02 + lean * share**2
    return painted(torch.stack([out * angle.cos(), out * angle.sin(), 0.5 * share], -1), GREEN, (-6.0, -6.0, -3.5))


def washing_line(posts=(0.0, 2.0)):
    """A towel on a line of 2 m between posts of 1.8 m with feet and arms: what moves, and all."""
    draw = torch.Generator().manual_seed(0)

    def box(count, low, high):
        low, high = torch.tensor(low), torch.tensor(high)
        return low + (high - low) * torch.rand(count, 3, generator=draw)

    towel = box(6000, [0.6, -0.005, 0.6], [1.4, 0.005, 1.65])
    line = box(400, [0.0, -0.005, 1.65], [2.0, 0.005, 1.67])
    rest = []
    for x in posts:
        rest.append(box(900, [x - 0.03, -0.03, 0.0], [x + 0.03, 0.03, 1.8]))
        rest.append(box(200, [x - 0.15, -0.15, 0.0], [x + 0.15, 0.15, 0.05]))  # foot
        rest.append(box(200, [x - 0.03, -0.3, 1.75], [x + 0.03, 0.3, 1.8]))  # arm
    return torch.cat([towel, line]), torch.cat([towel, line, *rest])


def sign(width=0.03):
    """A round plate of 0.6 m on a post of 1.5 m."""
    draw = torch.Generator().manual_seed(0)
    angle, share = 6.2832 * torch.rand(1500, generator=draw), torch.rand(1500, generator=draw)
    post = torch.stack([width * angle.cos(), width * angle.sin(), 1.5 * share], -1)
    plate = torch.stack(
        [0.3 * share.sqrt() * angle.sin(), 0.02 * angle.cos(), 1.7 + 0.3 * share.sqrt() * angle.cos()], -1
    )
    return plain_cloud(torch.cat([post, plate]) + torch.tensor([3.0, 4.0, 0.0]), -4.0, logit=2.0)


def potted_plant(spacing=0.01, reach=0.6):
    """The plant of the paper, with the floor near its pot."""
    cloud = alocasia(spacing=spacing)
    return cloud.select(cloud.means[:, :2].norm(dim=-1) < reach)


def small_tree(spacing=0.02):
    """A tree without its pot, 1.6 m high, its lowest branches at a quarter of it."""
    cloud = ficus(spacing=spacing)
    return cloud.select((cloud.means[:, :2].norm(dim=-1) < 0.9) & (cloud.means[:, 2] > 0.32))


def flag_on_a_pole(**settings):
    return FlagScene(**{"spacing": 0.025, "stand": "pole", **settings}).generate()


def as_captured(cloud, seed=0):
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    low, high = cloud.means.amin(0), cloud.means.amax(0)
    size, count = float((high - low).max()), len(cloud)
    scales = cloud.scales + 0.3 * normal(count, 3)
    scales[::20, 0] += 1.0
    places = cloud.means + 0.002 * size * normal(count, 3)
    dressed = GaussianCloud(places, cloud.quats, scales, 1.5 * normal(count) + 0.8, cloud.sh[:, :1])
    near = dressed.select(torch.randint(count, (count // 60,), generator=draw))
    fluff = dataclasses.replace(
        near, means=near.means + 0.012 * size * normal(len(near), 3), opacities=near.opacities - 3
    )
    floating = low + (high - low) * (1.16 * torch.rand(60, 3, generator=draw) - 0.08)
    haze = plain_cloud(floating.maximum(low), math.log(0.018 * size), logit=-3.5)
    quat = torch.tensor([1.0, 1.02, 0.015, 0.01])
    return turned_cloud(together(dressed, fluff, haze), quat / quat.norm())
