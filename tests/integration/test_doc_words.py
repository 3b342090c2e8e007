"""The pages written by hand stay short enough to read."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 26_000
"""Words by hand that the documentation has at most."""
LEFT_OUT = re.compile(
    r"(?<!`)<!-- begin: [^>]*-->.*?<!-- end -->"  # filled by tools/bench.py
    r"|^\|[^\n]*$"  # tables: numbers, most of them
    r"|^[ ]*(?P<fence>```+|~~~+)[^\n]*\n.*?^[ ]*(?P=fence)[ ]*$"
    r"|(?<!`)<!--.*?-->"
    r"|(?<=\])\([^()\s]*\)",  # the target of a link, not its text
    re.DOTALL | re.MULTILINE,
)


def words(text):
    """Words outside generated blocks, code blocks, comments and targets of links; the signs of Markdown are none."""
    return sum(any(sign.isalnum() for sign in word) for word in LEFT_OUT.sub(" ", text).split())


def test_words_by_hand_are_counted_and_nothing_else():
    text = """# Two words

| not | counted |
|---|---|
| nor | this |

A [link of four](https://example.org/page) <!-- unseen --> `inline`.
<!-- begin: speed.frames speed_cpu -->
| generated | row |
<!-- end -->
```python
code = "here"
```
  ~~~
  more code
  ~~~
Last.
"""
    assert words(text) == 2 + 5 + 1


def test_the_pages_are_short_enough():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
    counts = {page.name: words(page.read_text(encoding="utf-8")) for page in pages}
    for name, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:6} {name}")
    total = sum(counts.values())
    print(f"{total:6} words by hand, {LIMIT} at most")
    assert total <= LIMIT, f"{total} words by hand, {LIMIT} at most: shorten a page"
