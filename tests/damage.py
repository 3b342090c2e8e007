"""What may have happened to a file: bytes that changed, and entries of a document that are others."""

VALUES = (
    None, True, "", "x", "é", -1, 0, 1, 3, 2.5, 2**31, 2**63, 10**25, int("9" * 400), 1e30, -1e30, 1e308, float("nan"),
    float("inf"), [], {}, [[]], [1e30], [1, 2, 3], "..", "../../../etc/passwd", "\u0000", "/dev/zero", "2026-01-01",
    {"class_path": "Box"}, {"class_path": "os.system"}, {"class_path": None},
)  # fmt: skip
"""None of them is what a field expects everywhere."""


class Fuse:
    """Executes code when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def damaged(rng, content):
    data = bytearray(content)
    if not data or rng.random() < 0.03:
        return rng.choice((b"", b"[" * 100_000, rng.randbytes(500), bytes(len(data))))
    for _ in range(rng.choice((1, 1, 3, 10))):
        if not data:
            break
        at, kind = rng.randrange(len(data)), rng.random()
        if kind < 0.6:
            data[at] = rng.choice((0, 1, 127, 255, rng.randrange(256), data[at] ^ 1 << rng.randrange(8)))
        elif kind < 0.75:
            del data[at : at + rng.randrange(1, 40)]
        elif kind < 0.9:
            data[at:at] = rng.randbytes(rng.randrange(1, 9))
        else:
            del data[at:]
    return bytes(data)


def places(node):
    keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    return [(node, key) for key in keys] + [place for key in keys for place in places(node[key])]


def changed(rng, document):
    for _ in range(rng.choice((1, 1, 2))):
        node, key = rng.choice(places(document) or [({"": 0}, "")])
        kind = rng.random()
        if kind < 0.7 or not isinstance(node, dict):
            node[key] = rng.choice(VALUES)
        elif kind < 0.8:
            del node[key]
        elif kind < 0.9:
            node[f"{key}s"] = node.pop(key)
        else:
            other, place = rng.choice(places(document))
            node[key], other[place] = other[place], "exchanged"
    return document
