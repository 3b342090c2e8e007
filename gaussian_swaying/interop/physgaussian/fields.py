"""Reading a PhysGaussian configuration key by key, and collecting notes on differences."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from gaussian_swaying._checks import check_positive, check_vector


class Notes(list[str]):
    """Sentences on differences, each once."""

    def add(self, sentence: str) -> None:
        if sentence not in self:
            self.append(sentence)


class Fields:
    """The fields of a JSON object; a field that is never read is an error."""

    def __init__(self, fields: Any, where: str) -> None:
        if not isinstance(fields, Mapping):
            raise TypeError(f"Expected {where} to be a JSON object, but got {fields!r}.")
        self._fields, self._where, self._asked = fields, where, set[str]()

    def given(self, name: str) -> bool:
        return name in self._fields

    def get(self, name: str, *default: Any) -> Any:
        """The value of a key, or the default; ValueError if there is neither."""
        self._asked.add(name)
        if name in self._fields:
            return self._fields[name]
        if not default:
            raise ValueError(f"The key `{name}` of {self._where} is missing.")
        return default[0]

    def number(self, name: str, *default: float) -> float:
        value = self.get(name, *default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"Expected `{name}` of {self._where} to be a number, but got {value!r}.")
        return check_vector(name, [value], 1)[0]

    def positive(self, name: str, *default: float) -> float:
        value = self.number(name, *default)
        check_positive(name, value)
        return value

    def whole(self, name: str, *default: int, least: int = 1) -> int:
        """A whole number, ``least`` or larger."""
        value = self.number(name, *default)
        if value != int(value) or value < least:
            raise ValueError(
                f"Expected `{name}` of {self._where} to be a whole number of at least {least}, but got {value:g}."
            )
        return int(value)

    def flag(self, name: str, default: bool) -> bool:
        value = self.get(name, default)
        if not isinstance(value, bool):
            raise TypeError(f"Expected `{name}` of {self._where} to be true or false, but got {value!r}.")
        return value

    def list(self, name: str, *default: Any) -> Any:
        value = self.get(name, *default)
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"Expected `{name}` of {self._where} to be a list, but got {value!r}.")
        return list(value)

    def numbers(self, name: str, *default: Any) -> Any:
        value = self.list(name, *default)
        return list(check_vector(name, value, len(value)))

    def vector(self, name: str, *default: Sequence[float], length: int = 3) -> tuple[float, ...]:
        """A list of ``length`` finite numbers."""
        return check_vector(name, self.get(name, *default), length)

    def finish(self) -> None:
        """Raise ValueError, with a suggestion, if a key was never read."""
        for name in self._fields:
            if name not in self._asked:
                close = difflib.get_close_matches(name, sorted(self._asked), 1)
                hint = f"did you mean `{close[0]}`?" if close else f"known are {', '.join(sorted(self._asked))}."
                raise ValueError(f"Unknown key `{name}` in {self._where}: {hint}")


def part(name: str, **arguments: Any) -> dict[str, Any]:
    """The dict for a class and its arguments."""
    return {"class_path": name, "init_args": arguments}


def box(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    """A box between two corners."""
    return part("Box", min=[round(v, 12) for v in low], max=[round(v, 12) for v in high])


def box_about(point: Sequence[float], size: Sequence[float]) -> dict[str, Any]:
    """A box around a point, given half of its sides."""
    pairs = list(zip(point, size, strict=True))
    return box([p - s for p, s in pairs], [p + s for p, s in pairs])
