"""Triton's hash of itself, kept in a file: each process that launches a kernel would read half a gigabyte for it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from gaussian_swaying._files import cache_folder, write_text


def remember_key() -> None:
    """Make Triton, which is imported, take the hash of itself from a file. It is a part of the names of its cache."""
    import triton
    from triton.compiler import compiler
    from triton.runtime import cache as names

    for home in (names, compiler):  # the second until version 3.3
        if hasattr(home, "triton_key"):
            home.triton_key = _from_file(home.triton_key, Path(triton.__file__).parent)


def _from_file(key: Callable[[], str], root: Path) -> Callable[[], str]:
    """A function for the hash, which reads the file at the first call."""
    return cache(lambda: remembered(key, root))


def remembered(key: Callable[[], str], root: Path) -> str:
    """The hash from its file if nothing in a folder has changed since, or else from the function; it is then kept.

    Args:
        key: Computes the hash.
        root: The folder of Triton. Names, sizes and times of its modules and its library tell of a change.
    """
    parts: list[Any] = []
    for file in sorted([*root.rglob("*.py"), *root.glob("_C/libtriton.*")]):
        known = file.stat()
        parts.append((str(file), known.st_size, known.st_mtime_ns))
    kept = cache_folder() / f"triton_{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.key"
    try:
        return kept.read_text()
    except OSError:
        pass
    found = key()
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_text(kept, found)
    except OSError:  # a read-only home folder
        pass
    return found
