"""Argument checks. Each error is one sentence that names the argument and what was expected.

Shape checks are always on and never synchronise with a GPU. Value checks read the tensor, which makes a GPU wait, so
they run only when the environment variable ``GAUSSIAN_SWAYING_CHECKS`` is 1 (the tests set it).
"""

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gaussian_swaying._arguments import is_number, shown
from gaussian_swaying._numbers import Sense, sense_of

if TYPE_CHECKING:
    Number = float | Tensor
    VectorLike = Sequence[Number] | Tensor
else:  # what a YAML file can contain; in Python also tensors, which may require a gradient
    Number, VectorLike = float, Sequence[float]
MOST_FRAMES = 10_000_000
"""Frames of a run at most: more than four days of simulated time at 25 frames per second."""
VALUE_CHECKS = os.environ.get("GAUSSIAN_SWAYING_CHECKS", "0") == "1"


def check_shape(name: str, tensor: Tensor, *shape: int | str | None, batches: bool = True) -> None:
    """Check the trailing dimensions of a tensor.

    Args:
        shape: Expected trailing sizes; a letter or None stands for any size.
    """
    if not isinstance(tensor, Tensor):
        raise TypeError(f"Expected `{name}` to be a torch.Tensor, but got {type(tensor).__name__}.")
    actual = tuple(tensor.shape)
    fits = len(actual) >= len(shape) if batches else len(actual) == len(shape)
    trailing = actual[len(actual) - len(shape) :] if fits else None
    if trailing is None or any(isinstance(e, int) and e != a for e, a in zip(shape, trailing, strict=True)):
        expected = ", ".join("*" if s is None else str(s) for s in shape)
        comma = "," if len(shape) == 1 else ""
        raise ValueError(f"Expected `{name}` of shape ({expected}{comma}), but got {actual}.")


def requires_grad(value: Any) -> bool:
    """True if a value is a tensor that requires a gradient."""
    return isinstance(value, Tensor) and value.requires_grad


def check_plain(name: str, value: Any) -> None:
    """Raise ValueError if a value that becomes plain numbers, or an item of it, requires a gradient."""
    items = value if isinstance(value, Iterable) and not isinstance(value, Tensor | str | bytes) else [value]
    if any(map(requires_grad, items)):
        raise ValueError(
            f"Expected `{name}` without a gradient, which would be lost: give plain numbers (`tensor.detach()`); "
            "docs/configuration.md lists what keeps its gradient."
        )


def number_of(value: Any) -> Any:
    """The value of a tensor with one element as a float, without its gradient; anything else as it is."""
    return float(value.detach()) if isinstance(value, Tensor) and value.numel() == 1 else value


def check_vector(name: str, value: Any, length: int = 3) -> tuple[float, ...]:
    """Return ``value`` as a tuple of ``length`` finite floats, or raise an error that names the field."""
    check_plain(name, value)
    items = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(items, (str, bytes)) or not hasattr(items, "__len__"):
        raise TypeError(f"Expected `{name}` to be a list of {length} numbers, but got {shown(value)}.")
    if len(items) != length:
        raise ValueError(f"Expected `{name}` to have {length} numbers, but got {len(items)}: {shown(value)}.")
    if not all(map(is_number, items)):
        raise TypeError(f"Expected `{name}` to be a list of {length} numbers, but got {shown(value)}.")
    result = tuple(float(item) for item in items)
    if any(item != item or item in (float("inf"), float("-inf")) for item in result):
        raise ValueError(f"Expected `{name}` to be finite, but got {list(result)}.")
    for item in result:
        check_sense(name, item, 0.0)
    return result


def check_sense(name: str, value: float, least: float = 1e-12) -> None:
    """Raise ValueError unless a finite number lies in the sensible range of the setting of that name."""
    sense = sense_of(name)
    known = sense or Sense(low=least)
    if value and not known.low <= (value if sense else abs(value)) <= known.high:
        raise ValueError(f"Expected `{name}` {known.words}, but got {value:g}.")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"Expected `{name}` to be one of {', '.join(choices)}, but got {shown(value)}.")


def check_positive(name: str, value: float, *, allow_zero: bool = False) -> None:
    """Raise ValueError unless ``value`` is a finite number above zero (or at least zero, with ``allow_zero``)."""
    check_plain(name, value)
    if not is_number(value):
        raise TypeError(f"Expected `{name}` to be a number, but got {shown(value)}.")
    wanted = "not be negative" if allow_zero else "be positive"
    if not (value >= 0 if allow_zero else value > 0) or value == float("inf"):
        raise ValueError(f"Expected `{name}` to {wanted} and finite, but got {value}.")
    check_sense(name, value)


def check_whole(name: str, value: Any, least: int, most: int = 1 << 63) -> None:
    """Raise ValueError unless ``value`` is a whole number of at least ``least`` and at most ``most``."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        limit = f" and at most {most:,}" if most < 1 << 63 else ""
        raise ValueError(f"Expected `{name}` to be a whole number of at least {least}{limit}, but got {value!r:.60}.")


def check_frames(name: str, count: Any) -> int:
    """Return a number of frames, or raise an error that names the field."""
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MOST_FRAMES:
        shown = f"{count:.6g}" if isinstance(count, int) and abs(count) > MOST_FRAMES else repr(count)
        raise ValueError(f"Expected `{name}` to be a whole number from 1 to {MOST_FRAMES:,}, but got {shown}.")
    return count


def check_poisson_ratio(name: str, value: float) -> None:
    """Raise ValueError unless ``value`` is a Poisson's ratio of an elastic solid that can be compressed."""
    if not -1 < value < 0.5:
        raise ValueError(
            f"Expected `{name}` (Poisson's ratio) to lie between -1 and 0.5, both excluded, but got {value}: use 0.49 "
            "for something like rubber."
        )


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or the name of its kind."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def one_line(error: BaseException) -> str:
    """The whole message of an error in one line, or the name of its kind."""
    return " ".join(str(error).split()) or type(error).__name__


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise ValueError if a value is NaN or infinite; only with ``GAUSSIAN_SWAYING_CHECKS=1``."""
    if VALUE_CHECKS and not bool(torch.isfinite(tensor).all()):
        count = int((~torch.isfinite(tensor)).sum())
        raise ValueError(f"Expected `{name}` to be finite, but {count} of its values are NaN or infinite.")


def check_like(name: str, tensor: Tensor, like: Tensor, others: str = "the material is") -> None:
    """Check that a tensor has the precision and lies on the device of another one, which is named in the message."""
    if tensor.dtype != like.dtype:
        found, wanted = (str(dtype).removeprefix("torch.") for dtype in (tensor.dtype, like.dtype))
        raise TypeError(f"Expected `{name}` in {wanted}, as {others}, but got {found}: convert it with `.to`.")
    if tensor.device != like.device:
        raise ValueError(
            f"Expected `{name}` on {like.device}, where {others}, but it is on {tensor.device}: move it with `.to`."
        )
