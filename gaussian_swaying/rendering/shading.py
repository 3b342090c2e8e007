"""Shading of captured colours from the moving normals of the surface patches.

"Gaussian Swaying" (arXiv 2512.01306), section "Lightweight Shading": the diffuse term scales the colour of a patch by
the cosine between its normal and the light, and the Phong model (Phong 1975, "Illumination for computer generated
pictures") adds a highlight.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_shape, check_vector
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
    view_direction: Tensor | None = None,
    specular: float = 0.0,
    shininess: float = 32.0,
) -> Tensor:
    r"""Scale colours by the cosine between normal and light, and add the highlight of the Phong model.

    .. math::
        L_o = s\,c + k_s \max(0, \mathbf{r} \cdot \mathbf{v})^\alpha, \qquad
        s = a + (1 - a) \max(0, \mathbf{n} \cdot \mathbf{L}),
        \qquad \mathbf{r} = 2 (\mathbf{n} \cdot \mathbf{L})\, \mathbf{n} - \mathbf{L}

    (arXiv 2512.01306, "Lightweight Shading", whose diffuse form has a = 0 and no highlight). The highlight is white and
    is the same for **n** and **-n**. Captured colours already contain the light of the capture. With ``rest_normal``
    the factor is therefore :math:`\max(s, 0.1) / \max(s_\text{rest}, 0.1)`, and the highlight of the rest normal is
    subtracted, so the rest shape looks as captured, and there is no division by zero where it faces away from the
    light.

    Args:
        color: Colours, shape (..., 3).
        normal: Unit normals, shape (..., 3).
        light: Unit vector towards the light, in the frame of the normals, shape (3,).
        two_sided: Use :math:`|\mathbf{n} \cdot \mathbf{L}|` in s, for normals without a known outside.
        ambient: Share a of ambient light, in [0, 1].
        rest_normal: Unit normals of the rest shape, shape (..., 3), for shading relative to it.
        view_direction: Unit vectors from the surface to the eye, in the same frame, shape (..., 3); for a highlight.

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
    if specular == 0:
        return (color * scale).clamp_min(0.0)
    if view_direction is None:
        raise ValueError("Expected `view_direction` to be given, because the highlight depends on it.")
    check_shape("view_direction", view_direction, 3)
    against = (view_direction * light).sum(-1, keepdim=True)

    def highlight(normal: Tensor) -> Tensor:
        """max(0, r.v)^shininess with r.v = 2 (n.L) (n.v) - L.v."""
        facing = (normal * view_direction).sum(-1, keepdim=True)
        return (2.0 * (normal * light).sum(-1, keepdim=True) * facing - against).clamp_min(0.0) ** shininess

    more = highlight(normal) if rest_normal is None else highlight(normal) - highlight(rest_normal)
    return torch.add(color * scale, more, alpha=specular).clamp_min(0.0)


def _unit_light(light: Sequence[float]) -> Tensor:
    """Return a checked light direction of length one, shape (3,)."""
    direction = torch.tensor(check_vector("light", light), dtype=torch.float64)
    if float(direction.norm()) < 1e-12:
        raise ValueError("Expected `light` to be a direction, but got the zero vector.")
    return direction / direction.norm()


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
        view_direction: Tensor | None = None,
    ) -> Tensor:
        """Shade colours.

        Args:
            color: Colours, shape (..., 3).
            normal: Unit normals in the metric frame, shape (..., 3).
            rest_normal: Unit normals of the rest shape, shape (..., 3); needed when the shading is relative.
            view_direction: Unit vectors from the surface to the eye in the metric frame, shape (..., 3).

        Returns:
            Shaded colours, shape (..., 3).
        """


class DiffuseShader(Shader):
    """Diffuse shading, with a highlight if it is ``specular``: see :func:`diffuse_shading`.

    Args:
        light: Direction towards the light in the metric frame (z up), of any length.
        two_sided: Shade both sides of the surface in the same way.
        ambient: Share of ambient light, in [0, 1].
        specular: Coefficient of the highlight of the Phong model, not negative.
        shininess: Exponent of the highlight, positive.
        relative: Shade relative to the rest shape, which then looks as captured.

    Raises:
        TypeError: If ``light`` is not a list of numbers.
        ValueError: If ``light`` is zero or a coefficient is out of range.
    """

    recordable = True
    light: Tensor

    def __init__(
        self,
        light: Sequence[float] = (0.0, 0.0, 1.0),
        two_sided: bool = False,
        *,
        ambient: float = 0.0,
        specular: float = 0.0,
        shininess: float = 32.0,
        relative: bool = False,
    ) -> None:
        super().__init__()
        if not 0.0 <= ambient <= 1.0:
            raise ValueError(f"Expected `ambient` to be between 0 and 1, but got {ambient}.")
        check_positive("specular", specular, allow_zero=True)
        check_positive("shininess", shininess)
        self.register_buffer("light", _unit_light(light), persistent=False)
        self.two_sided, self.ambient, self.relative = bool(two_sided), float(ambient), bool(relative)
        self.specular, self.shininess = float(specular), float(shininess)

    def forward(
        self,
        color: Tensor,
        normal: Tensor,
        rest_normal: Tensor | None = None,
        view_direction: Tensor | None = None,
    ) -> Tensor:
        """See :class:`Shader`."""
        if self.relative and rest_normal is None:
            raise ValueError("Expected `rest_normal` to be given, because the shading is relative to the rest shape.")
        rest, light = rest_normal if self.relative else None, self.light.to(normal)
        more = view_direction, self.specular, self.shininess
        return diffuse_shading(color, normal, light, self.two_sided, self.ambient, rest, *more)
