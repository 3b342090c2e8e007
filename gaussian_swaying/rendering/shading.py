"""Shading of captured colours from the moving normals of the surface patches.

"Gaussian Swaying" (arXiv 2512.01306), section "Lightweight Shading": the diffuse term scales the colour of a patch by
the cosine between its normal and the light.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_shape
from gaussian_swaying.geometry.rotations import check_direction
from gaussian_swaying.kernels.graphs import Component

REST_FLOOR = 0.1
"""Relative shading clamps the factors of the moving and the rest normal to at least this before it divides them."""


def _relative(factor: Tensor, rest_factor: Tensor) -> Tensor:
    """Return the ratio of two factors, both clamped to at least ``REST_FLOOR``: exactly 1 where they are equal."""
    return factor.clamp_min(REST_FLOOR) / rest_factor.clamp_min(REST_FLOOR)


def diffuse_shading(
    color: Tensor,
    normal: Tensor,
    light: Tensor,
    two_sided: bool = False,
    ambient: float = 0.0,
    rest_normal: Tensor | None = None,
) -> Tensor:
    r"""Scale colours by the cosine between normal and light.

    .. math::
        L_o = s\,c, \qquad s = a + (1 - a) \max(0, \mathbf{n} \cdot \mathbf{L})

    (arXiv 2512.01306, "Lightweight Shading", which has a = 0). Captured colours already contain the light of the
    capture. With ``rest_normal`` the factor is therefore :math:`\max(s, 0.1) / \max(s_\text{rest}, 0.1)`, so the rest
    shape looks as captured, and there is no division by zero where it faces away from the light.

    Args:
        color: Colours, shape (..., 3).
        normal: Unit normals, shape (..., 3).
        light: Unit vector towards the light, in the frame of the normals, shape (3,).
        two_sided: Use :math:`|\mathbf{n} \cdot \mathbf{L}|` in s, for normals without a known outside.
        ambient: Share a of ambient light, in [0, 1].
        rest_normal: Unit normals of the rest shape, shape (..., 3), for shading relative to it.

    Returns:
        Shaded colours, not negative, shape (..., 3).

    Example:
        >>> color, light = torch.ones(3), torch.tensor([0.0, 0.0, 1.0])
        >>> diffuse_shading(color, torch.tensor([0.6, 0.0, 0.8]), light)
        tensor([0.8000, 0.8000, 0.8000])
    """
    check_shape("color", color, 3)
    check_shape("normal", normal, 3)
    check_shape("light", light, 3)
    if rest_normal is not None:
        check_shape("rest_normal", rest_normal, 3)

    def factor(normal: Tensor) -> Tensor:
        cosine = (normal * light).sum(-1, keepdim=True)
        return ambient + (1.0 - ambient) * (cosine.abs() if two_sided else cosine.clamp_min(0.0))

    scale = factor(normal) if rest_normal is None else _relative(factor(normal), factor(rest_normal))
    return (color * scale).clamp_min(0.0)


class Shader(Component, nn.Module, ABC):
    """Base class of the shaders that a configuration can name.

    For a custom shader, write a subclass with a ``forward``. If that never makes the host wait, set ``recordable =
    True``, and on a GPU it is replayed from a CUDA graph.
    """

    @abstractmethod
    def forward(
        self,
        color: Tensor,
        normal: Tensor,
        rest_normal: Tensor | None = None,
    ) -> Tensor:
        """Shade colours.

        Args:
            color: Colours, shape (..., 3).
            normal: Unit normals in the metric frame, shape (..., 3).
            rest_normal: Unit normals of the rest shape, shape (..., 3); needed when the shading is relative.

        Returns:
            Shaded colours, shape (..., 3).
        """


class DiffuseShader(Shader):
    """Diffuse shading: see :func:`diffuse_shading`.

    Args:
        light: Direction towards the light in the metric frame (z up), of any length.
        two_sided: Shade both sides of the surface in the same way.
        ambient: Share of ambient light, in [0, 1].
        relative: Shade relative to the rest shape, which then looks as captured.

    Raises:
        TypeError: If ``light`` is not a list of numbers.
        ValueError: If ``light`` is zero or ``ambient`` is out of range.
    """

    recordable = True
    light: Tensor

    def __init__(
        self,
        light: Sequence[float] = (0.0, 0.0, 1.0),
        two_sided: bool = False,
        *,
        ambient: float = 0.0,
        relative: bool = False,
    ) -> None:
        super().__init__()
        if not 0.0 <= ambient <= 1.0:
            raise ValueError(f"Expected `ambient` to be between 0 and 1, but got {ambient}.")
        self.register_buffer(
            "light", torch.tensor(check_direction("light", light), dtype=torch.float64), persistent=False
        )
        self.two_sided, self.ambient, self.relative = bool(two_sided), float(ambient), bool(relative)

    def forward(
        self,
        color: Tensor,
        normal: Tensor,
        rest_normal: Tensor | None = None,
    ) -> Tensor:
        """See :class:`Shader`."""
        if self.relative and rest_normal is None:
            raise ValueError("Expected `rest_normal` to be given, because the shading is relative to the rest shape.")
        rest = rest_normal if self.relative else None
        return diffuse_shading(color, normal, self.light.to(normal), self.two_sided, self.ambient, rest)
