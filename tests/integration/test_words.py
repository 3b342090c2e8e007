"""Docstrings say what something returns, does or is."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "gaussian_swaying"
QUESTIONS = {"What", "How", "Which", "Where", "Why", "Whether"}


def docstrings(source):
    """Line and text of each string that stands alone: of modules, classes, functions and attributes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


def questions(source):
    """Lines of the docstrings that begin like a question."""
    return [line for line, text in docstrings(source) if text.replace(",", " ").split()[:1][0] in QUESTIONS]


@pytest.mark.parametrize("word", sorted(QUESTIONS))
def test_a_docstring_that_begins_like_a_question_is_found(word):
    source = f'''
"""{word} it is."""

LIMIT = 1
"""{word} far it goes."""


class Body:
    """A body."""

    def moves(self):
        """{word}, if ever, it moves."""
'''
    assert questions(source) == [2, 5, 12]


def test_no_docstring_begins_like_a_question():
    found, count = [], 0
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        count += len(list(docstrings(source)))
        found += [f"{path.relative_to(PACKAGE.parent)}:{line}" for line in questions(source)]
    assert count > 2000
    assert found == [], f"begin these docstrings with a statement, not with one of {sorted(QUESTIONS)}"
