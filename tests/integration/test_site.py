import ast
import html
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gaussian_swaying

ROOT = Path(__file__).parents[2]
STUB = ROOT / "gaussian_swaying" / "__init__.pyi"


def public_names():
    for node in ast.parse(STUB.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            yield from ((alias.name, f"gaussian_swaying.{node.module}") for alias in node.names)


NAMES = dict(public_names())


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


def test_every_public_name_has_its_entry(site):
    page = (site / "reference" / "index.html").read_text("utf-8")
    assert len(NAMES) > 40
    missing = [n for n, home in NAMES.items() if f'id="{home}.{n}"' not in page]
    assert missing == [], "docs/reference.md needs a line `::: module.name` for these"
    assert set(re.findall(r"^::: (\S+)$", (ROOT / "docs" / "reference.md").read_text("utf-8"), re.MULTILINE)) == {
        f"{home}.{name}" for name, home in NAMES.items()
    }


def test_formulas_and_names_are_not_left_in_sphinx_s_notation(site):
    page = (site / "reference" / "index.html").read_text("utf-8")
    assert page.count("<math") > 5
    assert not re.search(r":(math|class|meth|func|mod):`|\.\. math::|\\tfrac|&gt;&gt;&gt; .*\n?</p>", page)


def test_pages_ask_no_other_site(site):
    for path in site.rglob("*.html"):
        text = path.read_text("utf-8")
        asked = re.findall(r'<(?:script|link|img|iframe)[^>]+(?:src|href)="(https?://[^"]+)"', text)
        assert [html.unescape(url) for url in asked if "canonical" not in url] == [], path


def test_every_public_name_is_described():
    missing = []
    for name, home in NAMES.items():
        found = getattr(importlib.import_module(home), name)
        text = inspect.getdoc(found) or ""
        assert len(text.splitlines()[0]) > 10, name
        assert getattr(gaussian_swaying, name) is found
        if inspect.isclass(found):
            if "__init__" not in vars(found):
                continue
            text = "\n".join(inspect.getdoc(base) or "" for base in found.__mro__)
        arguments = inspect.signature(found.__init__ if inspect.isclass(found) else found).parameters
        own = [one for one in arguments if one not in ("self", "args", "kwargs") and not one.startswith("_")]
        missing += [f"{name}.{one}" for one in own if not re.search(rf"^\s+\*{{0,2}}{one}: ", text, re.MULTILINE)]
    assert missing == [], "the docstring has no line for these in `Args:`"


def test_roles_become_markdown(monkeypatch):
    pytest.importorskip("latex2mathml")
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    from site_roles import as_markdown

    found = as_markdown(
        "See :class:`~a.b.C` and ``x``, :math:`a^2`.\n\n.. math:: b =\n    c\n\nExample:\n    >>> 1\n    1"
    )
    first, rest = found.split("\n\n", 1)
    assert first.startswith("See `C` and `x`, <math")
    assert rest.startswith("<math")
    assert "::" not in rest
    assert rest.endswith("Examples:\n    >>> 1\n    1")
