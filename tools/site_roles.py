"""For the site: the roles and formulas of docstrings, which are Sphinx's, as Markdown and MathML."""

from __future__ import annotations

import re
from typing import Any

import griffe
from latex2mathml.converter import convert

_ROLE = re.compile(r":(?:class|meth|func|mod|attr|data):`~?([^`]+)`")
_DISPLAY = re.compile(r"^( *)\.\. math::[ ]*(.*(?:\n(?:\1 +\S.*|[ ]*(?=\n\1 +\S)))*)", re.MULTILINE)


def as_markdown(text: str) -> str:
    """A docstring with Sphinx's roles in Markdown: names as code, formulas as MathML, which browsers draw."""
    text = re.sub(r"^( *)Example:$", r"\1Examples:", text, flags=re.MULTILINE)  # its prompts are code
    text = _DISPLAY.sub(lambda found: found[1] + convert(" ".join(found[2].split()), display="block"), text)
    text = re.sub(r":math:`([^`]+)`", lambda found: convert(" ".join(found[1].split())), text)
    text = _ROLE.sub(lambda found: f"`{found[1].rpartition('.')[2]}`", text)
    return re.sub(r"``([^`]+)``", r"`\1`", text)


class Roles(griffe.Extension):
    """Rewrites the docstring of each object."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """See :func:`as_markdown`."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
