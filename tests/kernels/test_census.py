"""No formula has two texts: all device functions of the package that can be traced, by what they compute."""

from collections import defaultdict
from importlib import import_module
from pkgutil import walk_packages

import gaussian_swaying
from gaussian_swaying.kernels.derive import TraceError, canonical


def test_no_formula_has_two_names():
    found, functions = defaultdict(set), {}
    for module in walk_packages(gaussian_swaying.__path__, "gaussian_swaying."):
        if module.name.rsplit(".", 1)[-1] == "__main__":
            continue
        for value in vars(import_module(module.name)).values():
            if type(value).__name__ in ("Function", "JITFunction", "InterpretedFunction"):
                functions[f"{value.__module__}.{value.__name__}"] = value
    refused = []
    for name, function in functions.items():
        try:
            found[canonical(function)].add(name)
        except TraceError:
            refused.append(name)
    assert len(found) > 60, refused  # formulas; kernels that load are no formulas
    assert [names for names in found.values() if len(names) > 1] == []
