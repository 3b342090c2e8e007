"""Tables of numbers from .ply files; the header is first compared with the size of the file."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_swaying._inputs import check_regular

LARGEST_HEADER = 1 << 16  # bytes; a splat of degree 3 takes 2,000
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
_TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass(frozen=True, slots=True)
class PlyElement:
    """One element of a header.

    Attributes:
        name: Its name, such as ``vertex``.
        fields: Name and numpy type of each property; None as the type of a list.
    """

    name: str
    count: int
    fields: tuple[tuple[str, str | None], ...]

    @property
    def lists(self) -> tuple[str, ...]:
        return tuple(name for name, kind in self.fields if kind is None)

    @property
    def row(self) -> int:
        """Size of a binary row [bytes]; the smallest possible one if there are lists."""
        return sum(1 if kind is None else int(kind[1:]) for _, kind in self.fields)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The header of a .ply file.

    Attributes:
        order: ``<`` or ``>`` for binary numbers, empty for text.
        elements: Its elements, in the order of the file.
        start: Offset of the data in the file [bytes].
    """

    order: str
    elements: tuple[PlyElement, ...]
    start: int


def read_header(path: str | os.PathLike[str]) -> PlyHeader:
    """Read the header of a .ply file, and compare its number of rows with the size of the file."""
    path = check_regular(path, "the .ply file")
    with path.open("rb") as stream:
        head = stream.read(LARGEST_HEADER)
    if not re.match(rb"ply\r?\n", head):
        raise ValueError(f"{path} is not a .ply file (it does not start with `ply`); export the scene as .ply.")
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise _broken(path, f"no `end_header` within its first {LARGEST_HEADER:,} bytes")
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    for number, line in enumerate(head[: end.start()].decode("ascii", "backslashreplace").splitlines()[1:], start=2):
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) > 1 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and re.fullmatch(r"\d{1,18}", words[2]):
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1][2].append((words[2], _TYPES[words[1]]))
        elif words[:2] == ["property", "list"] and elements and len(words) == 5 and {*words[2:4]} <= set(_TYPES):
            elements[-1][2].append((words[4], None))
        else:
            raise _broken(path, f"line {number} is {line[:80]!r}")
    if order is None:
        raise _broken(path, "it has no line `format`")
    header = PlyHeader(order, tuple(PlyElement(name, count, tuple(f)) for name, count, f in elements), end.end())
    for element in header.elements:
        names = [name for name, _ in element.fields]
        if len(set(names)) < len(names):
            raise _broken(path, f"the element `{element.name}` has a property twice")
    _check_size(path, header)
    return header


def read_element(path: str | os.PathLike[str], header: PlyHeader, name: str) -> np.ndarray:
    """Read one element of a binary .ply file, and nothing else.

    Returns:
        Structured array with a field for each property, shape (rows,).
    """
    kinds, count, start = layout(path, header, name)
    if count == 0:
        return np.zeros(0, dtype=kinds)
    return np.fromfile(path, dtype=kinds, count=count, offset=start)


def element_parts(
    path: str | os.PathLike[str], header: PlyHeader, name: str, rows: int = 1 << 16
) -> Iterator[np.ndarray]:
    """The same in parts of so many rows, one after the other; a large file is then never in memory as a whole."""
    kinds, count, start = layout(path, header, name)
    with Path(path).open("rb") as stream:
        stream.seek(start)
        for first in range(0, count, rows):
            yield np.fromfile(stream, dtype=kinds, count=min(rows, count - first))


def layout(path: str | os.PathLike[str], header: PlyHeader, name: str) -> tuple[np.dtype, int, int]:
    """Type of a row of an element, number of rows, and offset in the file [bytes]."""
    start = header.start
    for element in header.elements:
        if element.lists:
            raise ValueError(
                f"{path}: property `{element.lists[0]}` is a list (element `{element.name}`); export it as one float "
                "per Gaussian, without faces before them."
            )
        if element.name == name:
            kinds = np.dtype([(field, f"{header.order}{kind}") for field, kind in element.fields])
            return kinds, element.count if kinds.itemsize else 0, start
        start += element.count * element.row
    found = ", ".join(element.name for element in header.elements) or "none"
    raise ValueError(f"{path} has no element `{name}` (elements: {found}); export it from a 3DGS tool.")


def _check_size(path: Path, header: PlyHeader) -> None:
    size = path.stat().st_size - header.start
    if header.order == "":  # a digit and a separator for each number
        needed = sum(element.count * 2 * len(element.fields) for element in header.elements) - 1
    else:
        needed = sum(element.count * element.row for element in header.elements)
    if needed > size:
        rows = ", ".join(f"{element.count:,} of `{element.name}`" for element in header.elements)
        raise ValueError(
            f"{path} is truncated: its header announces {rows}, at least {needed:,} bytes, but {size:,} follow; copy "
            "or export the file again."
        )
    whole = header.order and not any(element.lists for element in header.elements)
    if whole and size - needed >= max([1, *(element.row for element in header.elements)]):
        raise ValueError(
            f"{path}: {size - needed:,} bytes follow the rows that `element` and `property` of its header announce; "
            "export the file again."
        )
    if whole and size > needed:
        warnings.warn(
            f"{path}: {size - needed:,} bytes follow that its header does not mention, so its numbers may be shifted; "
            "export the file again if they look odd.",
            UserWarning,
            stacklevel=4,
        )


def _broken(path: Path, what: str) -> ValueError:
    return ValueError(f"{path} has a broken .ply header ({what}); export the file again.")
