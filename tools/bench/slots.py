"""Slots: the places in a Markdown page that show records.

People edit the pages. A table, or a number within a sentence, is placed between two comments::

    <!-- begin: speed.substeps speed_cuda -->

    | substep | median [ms] |
    ...

    <!-- end -->

    A flag is <!-- begin: flags.distance flags_cuda ours 3 -->1.2 %<!-- end --> away from its reference.

The words of the first comment are the name of the slot, the record that it is made from, and further arguments of the
slot. :func:`fill` replaces the text between the comments and leaves all other text as it is. A comment in backquotes is
plain text.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from typing import Any

Row = dict[str, Any]
Records = Mapping[str, Row]
"""The records, by file name without ``.json``."""

_MARK = re.compile(r"(?<!`)<!-- (?:begin:\s*(?P<words>[^>]*?)|(?P<end>end)) -->")


class SlotError(ValueError):
    """A page cannot be filled; the message names the page and the slot."""


@dataclass(frozen=True)
class Slot:
    """One kind of slot.

    Attributes:
        name: First word of the comment.
        page: The page that must show it; None if no page must.
        records: Pattern (for ``fnmatch``) of the records that it is made from.
        together: Whether it is made from all of these records together; its words then name no record.
        make: Function of the record (or the list of all) and of the words that follow; returns text or lines.
        words: How many words follow.
    """

    name: str
    page: str | None
    records: str
    together: bool
    make: Callable[..., Any]
    words: int = 0


SLOTS: dict[str, Slot] = {}
"""All slots, by name."""


def table(page: str | None, name: str, records: str, together: bool = False) -> Callable[[Any], Any]:
    """Register a function that makes lines: a slot that ``page`` must have (if it is one), once for each record."""

    def register(make: Callable[..., list[str]]) -> Callable[..., list[str]]:
        SLOTS[name] = Slot(name, page, records, together, make)
        return make

    return register


def value(name: str, records: str, together: bool = False) -> Callable[[Any], Any]:
    """Register a function that makes a few words: an optional slot within a sentence."""

    def register(make: Callable[..., str]) -> Callable[..., str]:
        words = len(inspect.signature(make).parameters) - 1
        SLOTS[name] = Slot(name, None, records, together, make, words)
        return make

    return register


def fill(page: str, text: str, records: Records) -> str:
    """The text of a page with its slots filled from the records.

    Raises:
        SlotError: If a comment has no partner, or a slot is unknown, misplaced or cannot be made.
    """
    parts, place, words = [], 0, None
    for mark in _MARK.finditer(text):
        line = text.count("\n", 0, mark.start()) + 1
        if mark["end"] is None:
            if words is not None:
                raise SlotError(
                    f"{page}, line {line}: slot `{words}` has no `<!-- end -->` before the next one begins."
                )
            words = mark["words"]
            parts.append(text[place : mark.end()])
            alone = _is_alone(text, mark.start(), mark.end())
        else:
            if words is None:
                raise SlotError(f"{page}, line {line}: `<!-- end -->` ends no slot.")
            if not alone and "\n" in text[place : mark.start()]:
                raise SlotError(f"{page}: slot `{words}` has no `<!-- end -->` in its line.")
            parts.append(_content(page, words, alone, text[: mark.start()].rpartition("\n")[2], records))
            parts.append(mark.group())
            words = None
        place = mark.end()
    if words is not None:
        raise SlotError(f"{page}: slot `{words}` has no `<!-- end -->`.")
    return "".join([*parts, text[place:]])


def used(text: str) -> list[str]:
    """The words of all slots of a page."""
    return [" ".join(mark["words"].split()) for mark in _MARK.finditer(text) if mark["end"] is None]


def wanted(page: str, records: Records) -> list[str]:
    """The words of the slots that a page must have for these records."""
    found = []
    for slot in SLOTS.values():
        if slot.page == page:
            files = [name for name in records if fnmatch(name, slot.records)]
            found += [slot.name] * bool(files) if slot.together else [f"{slot.name} {name}" for name in files]
    return found


def check_complete(page: str, text: str, records: Records) -> None:
    """Raise a SlotError if a page lacks a slot that it must have."""
    if missing := [words for words in wanted(page, records) if words not in used(text)]:
        raise SlotError(f"{page} lacks the slot `{missing[0]}`: add `<!-- begin: {missing[0]} -->` and `<!-- end -->`.")


def _is_alone(text: str, start: int, end: int) -> bool:
    """Whether a comment is alone on its line."""
    before, after = text[:start].rpartition("\n")[2], text[end:].partition("\n")[0]
    return not before.strip() and not after.strip()


def _content(page: str, words: str, alone: bool, line: str, records: Records) -> str:
    """The content of a slot; ``line`` is its line up to the end comment."""
    try:
        made = _made(words, records)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        reason = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        raise SlotError(f"{page}: slot `{words}` cannot be filled: {reason}.") from error
    if isinstance(made, list) != alone:
        place = "lines of their own" if isinstance(made, list) else "one line with the sentence around it"
        raise SlotError(f"{page}: slot `{words}` needs its comments on {place}.")
    if alone:
        body = "\n".join(made).strip("\n")
        return f"\n\n{body}\n\n" if body else "\n"
    if line.startswith("<!--"):
        raise SlotError(
            f"{page}: slot `{words}` starts its line, which Markdown would take for HTML: put a word before."
        )
    return made


def _made(words: str, records: Records) -> Any:
    name, *rest = words.split() or [""]
    if name not in SLOTS:
        raise ValueError(f"it is unknown; the slots are {', '.join(sorted(SLOTS))}")
    slot = SLOTS[name]
    if slot.together:
        source: Any = [records[file] for file in sorted(records) if fnmatch(file, slot.records)]
    else:
        if not rest or not fnmatch(rest[0], slot.records):
            raise ValueError(f"after its name comes a recorded file, {slot.records}")
        if rest[0] not in records:
            raise ValueError(f"there is no {rest[0]}.json among the results")
        source = records[rest.pop(0)]
    if len(rest) != slot.words:
        raise ValueError(f"it takes {slot.words} more words, not {len(rest)}")
    return slot.make(source, *rest)
