"""The rooms of the package: imports run one way, and there is no circle."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2] / "gaussian_swaying"
FLOORS = (
    "kernels",
    "geometry",
    "gaussians metrics mpm runs",
    "air",
    "aero rendering scenes",
    "captures",
    "interop recording",
    "config",
    "simulation training",
    "evaluation fitting preview sweeps",
    "viewer",
    "cli",
)
"""From the ground up; rooms of one floor do not know each other."""

FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms.split()}
PRIVATE = -1  # _checks and the like lie below all rooms
FILES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}


def _imports(module):
    """Modules of the package that a module imports anywhere in its file, those for type checking alone included."""
    found = set()
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == ROOT.name:
            found |= {name if (name := f"{node.module}.{a.name}") in FILES else node.module for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.split(".")[0] == ROOT.name}
        assert not (isinstance(node, ast.ImportFrom) and node.level), f"{module}: relative import"
    return found - {module, ROOT.name}


def _floor(module):
    parts = module.split(".")
    return PRIVATE if len(parts) == 2 and parts[1].startswith("_") else FLOOR[parts[1]]


def test_every_room_has_a_floor():
    assert {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()} == set(FLOOR)


def test_imports_run_downwards():
    upwards = [
        f"{module} imports {other}"
        for module in FILES
        for other in _imports(module)
        if _floor(module) != PRIVATE and other.split(".")[1:2] != module.split(".")[1:2]
        if _floor(other) >= _floor(module)
    ]
    assert upwards == [], "a room imports only from those below it (FLOOR, docs/architecture.md): move the code down"


def test_what_lies_below_the_rooms_knows_none():
    private = [module for module in FILES if module != ROOT.name and _floor(module) == PRIVATE]
    assert private
    assert [(m, other) for m in private for other in _imports(m) if _floor(other) != PRIVATE] == []


def test_there_is_no_circle():
    """Files that import each other, also within a room, a function or for types, cannot be read one after the other."""
    graph = {module: _imports(module) & set(FILES) for module in FILES}
    done: set[str] = set()

    def visit(module, path):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for other in sorted(graph[module]):
                visit(other, [*path, module])
            done.add(module)

    for module in FILES:
        visit(module, [])


def test_metrics_stand_alone():
    """Another project can copy the folder."""
    imported = {other for module in FILES if ".metrics" in module for other in _imports(module)}
    assert {other for other in imported if ".metrics" not in other} == {f"{ROOT.name}._checks"}


TORCHS_OWN = {"_apply", "_buffers", "_modules", "_version"}
"""Private names of PyTorch that have no public form: what modules hold and move, and whether a tensor was changed."""


def _private(name):
    return name.startswith("_") and not name.endswith("__")


def test_private_names_of_mpm_stay_in_their_file():
    """A private name is read from ``self``, ``cls`` or ``super()``, and never imported."""
    read = []
    for module in (module for module in FILES if module.split(".")[1:2] == ["mpm"]):
        for node in ast.walk(ast.parse(FILES[module].read_text())):
            if isinstance(node, ast.ImportFrom):
                read += [(module, alias.name) for alias in node.names if _private(alias.name)]
            elif isinstance(node, ast.Attribute) and _private(node.attr) and node.attr not in TORCHS_OWN:
                own = ast.unparse(node.value) in {"self", "cls", "super()"}
                read += [] if own else [(module, ast.unparse(node))]
    assert read == [], "give these a public name, or move the code that uses them"
