"""Malformed configurations: values of the wrong kind, structure that is broken, bombs, other encodings."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml
from sandbox import Case
from small import FLAG, PIN

VALUES = (
    None, True, "", "soft", "é", -1, 0, 1e30, -1e30, float("nan"), float("inf"), 10**30, int("9" * 400), [], {}, [[]],
    [1, 2], [1, 2, 3, 4], ["a", "b", "c"], {"class_path": "Box"}, {"class_path": "os.system"}, {"class_path": None},
    {"class_path": "Sand", "init_args": {"x": 1}}, "2026-01-01", "0x10", "1e5", "1_000", {"a": {"b": {"c": 1}}},
)  # fmt: skip
TAGS = ("!!python/object/apply:os.system ['true']", "!!binary aGVsbG8=", "!!set {a, b}", "!!float x", "!unknown 3")
Change = Callable[[random.Random], bytes]


def _tree() -> Any:
    """The configuration of the flag, made small."""
    tree = yaml.safe_load(FLAG.read_text(encoding="utf-8"))
    tree["frames"], tree["solver"]["dx"], tree["solver"]["boundaries"] = 2, 0.2, PIN
    tree["scene"]["generator"]["init_args"]["spacing"] = 0.1
    tree["camera"]["init_args"] |= {"width": 32, "height": 18}
    return tree


def _text() -> str:
    return str(yaml.safe_dump(_tree(), sort_keys=False))


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Every container with each of its keys."""
    keys = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
    return [(node, key) for key in keys] + [place for key in keys for place in _places(node[key])]


def _value(rng: random.Random) -> bytes:
    tree = _tree()
    for _ in range(rng.choice((1, 1, 1, 3))):
        node, key = rng.choice(_places(tree))
        node[key] = rng.choice(VALUES)
    return yaml.safe_dump(tree, allow_unicode=True).encode()


def _rename(rng: random.Random) -> bytes:
    tree = _tree()
    node, key = rng.choice([place for place in _places(tree) if isinstance(place[0], dict)])
    other = key[:-1] if rng.random() < 0.5 else rng.choice(("x", "config", "preset", "help", "print_config", "<<", "."))
    node[other] = node.pop(key)
    return yaml.safe_dump(tree).encode()


def _swap(rng: random.Random) -> bytes:
    tree = _tree()
    (one, a), (two, b) = rng.sample(_places(tree), 2)
    one[a], two[b] = two[b], "swapped"
    return yaml.safe_dump(tree).encode()


def _flip(rng: random.Random) -> bytes:
    data = bytearray(_text().encode())
    for _ in range(rng.choice((1, 2, 10))):
        data[rng.randrange(len(data))] = rng.choice((rng.randrange(256), *b"\n\t:-{}[]&*!|>'\"%@`#"))
    return bytes(data)


def _cut(rng: random.Random) -> bytes:
    data = _text().encode()
    return data[: rng.randrange(len(data))]


def _tag(rng: random.Random) -> bytes:
    lines = _text().splitlines()
    index = rng.choice([i for i, line in enumerate(lines) if ": " in line and "#" not in line.split(": ")[0]])
    lines[index] = lines[index].split(": ")[0] + ": " + rng.choice(TAGS)
    return "\n".join(lines).encode()


def _bomb(rng: random.Random) -> bytes:
    width, depth = rng.choice((2, 9, 30)), rng.choice((3, 12, 40))
    lines = ["a0: &a0 [" + ", ".join(["1"] * width) + "]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * width)}]" for i in range(1, depth)]
    return ("\n".join(lines) + f"\n{rng.choice(('background', 'edits', 'wind', 'x'))}: *a{depth - 1}\n").encode()


def _cycle(rng: random.Random) -> bytes:
    name = rng.choice(("wind", "scene", "edits", "camera", "cameras", "background"))
    return (f"{name}: &a [*a, *a]\n" if rng.random() < 0.5 else f"{name}: &a {{flow: *a, b: [*a]}}\n").encode()


def _deep(rng: random.Random) -> bytes:
    count, name = rng.choice((10, 60, 70, 900, 3000, 200_000)), rng.choice(("wind: ", "edits: ", "background: ", ""))
    opening = rng.choice(("[", "{a: ", "- "))
    return (name + opening * count).encode()


def _large(rng: random.Random) -> bytes:
    entry = rng.choice(("- {time: 1.0, E: 2.0}\n", "- 1\n", "- - - a\n", "# nothing\n", "- " + "x" * 500 + "\n"))
    return (rng.choice(("edits", "background", "output")) + ":\n" + entry * rng.choice((500, 5000, 400_000))).encode()


def _encoding(rng: random.Random) -> bytes:
    text = _text() + "output: Blüte é\n"
    return text.encode(rng.choice(("latin-1", "utf-16", "utf-32", "utf-8-sig", "utf-7", "cp037")))


def _noise(rng: random.Random) -> bytes:
    return rng.randbytes(rng.choice((0, 1, 50, 5000)))


CHANGES: tuple[Change, ...] = (
    _value, _value, _value, _value, _rename, _swap, _flip, _flip, _cut, _tag, _bomb, _cycle, _deep, _large, _encoding,
    _noise,
)  # fmt: skip


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed."""
    for number in range(count):
        rng = random.Random(f"yaml {seed} {number}")
        change = rng.choice(CHANGES)

        def make(folder: Path, rng: random.Random = rng, change: Change = change) -> list[str]:
            path = folder / "bad.yaml"
            path.write_bytes(change(rng))
            return ["--config", str(path), "--device", "cpu", "--output", "run"]

        yield Case("yaml", f"{number} {change.__name__.strip('_')}", "sim", make)
