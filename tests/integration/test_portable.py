"""Nothing in the package needs a POSIX system, and text files have an encoding: on Windows the default is not UTF-8.

It was not run on Windows; this finds what can be seen without one.
"""

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "gaussian_swaying"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios"}
"""Modules that only POSIX systems have."""
CALLS = {
    "os": {"chown", "fork", "forkpty", "geteuid", "getpgid", "getuid", "killpg", "mkfifo", "nice", "setsid", "wait3"},
    "signal": {"SIGALRM", "SIGHUP", "SIGKILL", "SIGUSR1", "SIGUSR2", "alarm", "pause", "setitimer"},
}
GUARDED = {("_provenance.py", "resource")}
"""Modules that are imported within a try."""


@cache
def _tree(path):
    return ast.parse(path.read_text("utf-8"))


def posix_only(tree, name):
    """What a file uses that only POSIX systems have."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from {alias.name for alias in names} & MODULES - {m for f, m in GUARDED if f == name}
            case ast.ImportFrom(module=module, names=names):
                if module in MODULES:
                    yield module
                yield from (f"{module}.{a.name}" for a in names if a.name in CALLS.get(module, ()))
            case ast.Attribute(value=ast.Name(id=module), attr=attribute):
                if attribute in CALLS.get(module, ()):
                    yield f"{module}.{attribute}"
            case ast.Call(func=ast.Name(id="get_context") | ast.Attribute(attr="get_context"), args=[way, *_]):
                if getattr(way, "value", None) != "spawn":
                    yield "get_context without spawn"


def without_encoding(tree):
    """The lines of a file in which text is read or written in the encoding of the system."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, (ast.Attribute, ast.Name)):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
        if ast.unparse(node.func) == "tarfile.open":
            continue  # its mode is not that of a text
        named = any(word.arg == "encoding" for word in node.keywords)
        if name == "read_text" and not node.args and not named:
            yield node.lineno
        if name == "write_text" and isinstance(node.func, ast.Attribute) and len(node.args) < 2 and not named:
            yield node.lineno
        modes = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        text = any(mode in ("r", "w", "a", "x", "rt", "wt") for mode in modes)
        if name == "open" and not named and (text or any(word.arg in ("newline", "errors") for word in node.keywords)):
            yield node.lineno


def test_no_file_needs_a_posix_system():
    found = {path.relative_to(PACKAGE).as_posix(): list(posix_only(_tree(path), path.name)) for path in FILES}
    assert len(found) > 300
    assert not {path: uses for path, uses in found.items() if uses}


def test_text_files_have_an_encoding():
    found = {path.relative_to(PACKAGE).as_posix(): list(without_encoding(_tree(path))) for path in FILES}
    assert not {path: lines for path, lines in found.items() if lines}


@pytest.mark.parametrize(
    "text",
    [
        "import fcntl",
        "from os import fork",
        "import os\nos.killpg(1, 2)",
        "import signal\nsignal.SIGKILL",
        "from multiprocessing import get_context\nget_context('fork')",
    ],
)
def test_what_only_posix_has_is_found(text):
    assert list(posix_only(ast.parse(text), "file.py"))


@pytest.mark.parametrize("text", ["path.read_text()", "path.write_text(x)", "open(path, 'w')", "path.open(newline='')"])
def test_text_without_an_encoding_is_found(text):
    assert list(without_encoding(ast.parse(text)))
