"""Standard output and error that do not end a command when they are closed, full or cannot show a character."""

from __future__ import annotations

import os
import sys
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast


class SafeStream:
    """A text stream that stores its first failure instead of raising it, and drops everything after it.

    Characters missing in its encoding are replaced by similar plain ones: ``kg/m³`` becomes ``kg/m3``.

    Args:
        stream: The stream to write to.

    Attributes:
        error: The first error of writing; None if there was none.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | ValueError | None = None

    def write(self, text: str) -> int:
        """Write what can be written."""
        self._try(lambda: self._stream.write(encodable(text, self._stream.encoding)))
        return len(text)

    def flush(self) -> None:
        """Flush, if that is still possible."""
        self._try(self._stream.flush)

    def _try(self, action: Callable[[], object]) -> None:
        if self.error is not None:
            return
        try:
            action()
        except (OSError, ValueError) as error:  # ValueError: the stream is closed
            self.error = error
            _lead_nowhere(self._stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def encodable(text: str, encoding: str | None) -> str:
    """The text, with characters missing in an encoding replaced by similar ones, or by a question mark.

    Example:
        >>> encodable("5 kg/m³", "ascii"), encodable("5 kg/m³", "utf-8")
        ('5 kg/m3', '5 kg/m³')
    """
    encoding = encoding or "utf-8"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
        return "".join(letters).encode(encoding, "replace").decode(encoding)
    return text


def _lead_nowhere(stream: TextIO) -> None:
    """Discard the rest of a stream's buffer; otherwise the interpreter fails to flush it at its end."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return
    if descriptor in (1, 2):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


def _open_closed() -> None:
    """Open null devices for a process that was started without standard streams.

    Otherwise the next opened file gets their number, and output of libraries is written to it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number


@contextmanager
def safe_streams() -> Iterator[tuple[SafeStream, SafeStream]]:
    """Replace ``sys.stdout`` and ``sys.stderr`` by a :class:`SafeStream` each inside the block, and return them."""
    before = sys.stdout, sys.stderr
    if None in before:
        _open_closed()
    opened = [stream if stream is not None else open(os.devnull, "w", encoding="utf-8") for stream in before]  # noqa: SIM115
    output, errors = (SafeStream(stream) for stream in opened)
    sys.stdout, sys.stderr = cast(TextIO, output), cast(TextIO, errors)
    try:
        yield output, errors
    finally:
        output.flush()
        errors.flush()
        sys.stdout, sys.stderr = before
        for stream, was in zip(opened, before, strict=True):
            if was is None:
                stream.close()
