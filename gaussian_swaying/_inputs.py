"""Checks of user files: one that is not a regular file, or far too large, is refused before it is read."""

from __future__ import annotations

import codecs
import json
import os
import stat
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

LARGEST_JSON = 1 << 28  # bytes; a capture of 10,000 images takes 10 MB
LARGEST_HEAD = 1 << 24  # bytes of the JSON in a binary file
MOST_ENTRIES = 1 << 22  # in a JSON file; each takes up to 100 bytes of memory
LONGEST_NUMBER = 32  # digits of a whole number
_SPARE = ContextVar("_SPARE", default=1 << 29)  # bytes of memory that any compressed file may take
_SHARE = 100  # and so many times its size


def check_regular(path: str | os.PathLike[str], what: str = "the file", largest: int | None = None) -> Path:
    """Return a path if it is a regular file, and not a folder, or a device or pipe that may never end.

    Args:
        largest: Largest allowed size [bytes].
    """
    path = Path(path)
    try:
        found = path.stat()
    except ValueError as error:  # a zero byte
        raise ValueError(f"{str(path)!r} is not a valid path ({error}); check the path of {what}.") from None
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} does not exist; check the path of {what}.") from None
    if stat.S_ISDIR(found.st_mode):
        raise ValueError(f"{path} is a directory; give {what} inside it.")
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{path} is not a regular file; save {what} to a file first and give that.")
    size = found.st_size
    if largest is not None and size > largest:
        raise ValueError(f"{path} has {size:,} bytes, more than the {largest:,} that {what} may have; check the path.")
    return path


def read_json(path: str | os.PathLike[str], what: str, largest: int = LARGEST_JSON) -> Any:
    """Read a JSON file.

    Args:
        what: Name of the file in the message, for example "camera file".
        largest: Largest allowed size [bytes].
    """
    try:
        content = check_regular(path, f"the {what}", largest).read_bytes()
    except FileNotFoundError as error:
        raise ValueError(f"Cannot read the {what} `{path}` (no such file): check the path.") from error
    except OSError as error:
        raise ValueError(f"Cannot read the {what} `{path}` ({error.strerror or error}): check the path.") from error
    return parse_json(content, what, path)


def decoded(content: bytes) -> str:
    """Text of a file in UTF-8, or in UTF-16 with a byte order mark."""
    wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return content.decode("utf-16" if wide else "utf-8-sig")


def parse_json(content: bytes, what: str, path: str | os.PathLike[str]) -> Any:
    """Parse JSON from a file or a part of one."""
    entries = sum(map(content.count, (b",", b"[", b"{")))
    if entries > MOST_ENTRIES:
        raise ValueError(
            f"The {what} `{path}` has {entries:,} entries, more than the {MOST_ENTRIES:,} that it may have."
        )
    try:
        return json.loads(decoded(content), parse_int=_whole)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"The {what} `{path}` is not valid JSON ({error}): export it again.") from error
    except RecursionError as error:
        raise ValueError(f"The {what} `{path}` is nested too deeply: export it again.") from error
    except _LongNumberError as error:
        raise ValueError(f"The {what} `{path}` holds {error}: correct it.") from error


def check_archive(path: str | os.PathLike[str], what: str) -> Path:
    """Return a path if it is a .npz file whose arrays take no more than a gigabyte plus ten times its size."""
    path = check_regular(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            held = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} is not a .npz file, or is incomplete ({error}); make {what} again.") from error
    if held > (1 << 30) + 10 * path.stat().st_size:
        raise ValueError(f"{path} claims to contain {held:,} bytes, far more than its size; make {what} again.")
    return path


@contextmanager
def spare_memory(amount: int) -> Iterator[None]:
    """Within the block, compressed files may take this much memory [bytes] besides a multiple of their size."""
    token = _SPARE.set(amount)
    try:
        yield
    finally:
        _SPARE.reset(token)


def check_unpacked(path: Path, needed: int, what: str, size: int | None = None) -> None:
    """Check what a compressed file announces before it is decompressed.

    Args:
        needed: Memory that reading it takes at the most [bytes].
        what: The announced content, for the message, for example "a `count` of 8,000 Gaussians".
        size: Size of all files that hold it [bytes]; that of the file if None.
    """
    size = path.stat().st_size if size is None else size
    if needed > _SPARE.get() + _SHARE * size:
        raise ValueError(
            f"{path} announces {what}, far more than its {size:,} bytes can hold; copy or export it again."
        )


def read_arrays(
    path: str | os.PathLike[str], what: str, needed: Sequence[str], optional: Sequence[str] = (), only: bool = False
) -> dict[str, np.ndarray]:
    """Read arrays from a .npz file; no code in it is executed.

    Args:
        what: Name of the kind of file, for the message, for example "the reference".
    """
    try:
        path = check_archive(path, what)
    except OSError as error:
        raise ValueError(str(error)) from error
    try:
        with np.load(path) as archive:
            found = {name: archive[name] for name in (*needed, *optional) if name in archive}
            unknown = sorted(set(archive.files) - {*needed, *optional})
    except MemoryError:
        raise ValueError(f"{path} announces more than it contains: make {what} again.") from None
    except Exception as error:  # pickled, ...
        raise ValueError(f"{path} cannot be read ({error}): make {what} again.") from error
    if only and unknown:
        raise ValueError(f"{path} has the array `{unknown[0]}`, which {what} cannot have: remove or rename it.")
    for name in needed:
        if name not in found:
            raise ValueError(f"{path} has no array `{name}`: make {what} again.")
    return found


class _LongNumberError(ValueError):
    """A whole number that is too long for any field."""


def _whole(digits: str) -> int:
    if len(digits) > LONGEST_NUMBER:
        raise _LongNumberError(f"a whole number of {len(digits)} digits ({digits[:8]}...)")
    return int(digits)
