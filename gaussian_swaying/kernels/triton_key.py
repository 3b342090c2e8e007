"""Triton's hash of itself, kept in a file: each process that launches a kernel would read half a gigabyte for it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from gaussian_swaying._files import cache_folder, write_text


def remember_key() -> None:
    """Make Triton, which is imported, take the hash of itself from a file. It is a part of the names of its cache."""
    import triton
    from triton.compiler import compiler
    from triton.runtime import cache as names

    for home in (names, compiler):  # the second until version 3.3
        if hasattr(home, "triton_key"):
            home.triton_key = cache(partial(remembered, home.triton_key, Path(triton.__file__).parent))


def remembered(key: Callable[[], str], root: Path) -> str:
    """The hash from its file if nothing in a folder has changed since, or else from the function; it is then kept.

    Args:
        root: The folder of Triton. Names, sizes and times of its modules and its library tell of a change.
    """
    files = sorted([*root.rglob("*.py"), *root.glob("_C/libtriton.*")])
    parts = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    kept = cache_folder() / f"triton_{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.key"
    try:
        return kept.read_text(encoding="utf-8")
    except OSError:
        pass
    found = key()
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_text(kept, found)
    except OSError:  # a read-only home folder
        pass
    return found
