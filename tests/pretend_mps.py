"""A pretended Apple GPU: tensors that say they are on ``mps`` while the CPU computes them.

Nothing here runs on Metal. What is checked is what torch would refuse there, before it computes anything:

- a tensor of double precision (float64, complex128), which Metal does not have;
- an operation without a kernel for MPS. The list is torch's own: ``native_functions.yaml`` of the installed version,
  which names the backends of each operation, and those that ``aten/src/ATen/mps/MPSFallback.mm`` computes on the CPU;
- tensors of both devices in one operation, except for scalars of the CPU. Those may be of double precision, as the
  kernels read them as float (``convert_double_scalar`` in ``aten/src/ATen/native/mps/OperationUtils.mm``).

Kernels that refuse some dtypes or sizes, and what they round, only show on a Mac.
"""

import traceback
from collections import Counter
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import torch
import torchgen
import yaml
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

MPS = torch.device("mps")
DOUBLE = (torch.float64, torch.complex128)
BY_CPU = ("embedding_renorm_", "linalg_svd", "linalg_svd.U", "col2im", "upsample_nearest3d.vec")
"""Operations that MPS passes to the CPU by itself (torch 2.13, MPSFallback.mm)."""
MIXED = ("_to_copy", "copy_", "index.Tensor", "index_put_", "index_put", "_index_put_impl_", "_unsafe_index.Tensor")
"""Operations that take tensors of two devices: copies, and indices on the CPU."""


@cache
def listed():
    """The operations of ``native_functions.yaml`` by name, each with its backends and the one that computes it."""
    path = Path(torchgen.__file__).parent / "packaged" / "ATen" / "native" / "native_functions.yaml"
    found = {}
    for entry in yaml.safe_load(path.read_text(encoding="utf-8")):
        backends = [key.strip() for keys in entry.get("dispatch", {}) for key in keys.split(",")]
        found[entry["func"].split("(")[0]] = (frozenset(backends), entry.get("structured_delegate"))
    return found


@cache
def runs_on_mps(name):
    """True if MPS has a kernel for an operation, such as ``add.Tensor``, or torch makes it of others that it has."""
    backends, delegate = listed()[name]
    if delegate:
        return runs_on_mps(delegate)
    return not backends or "MPS" in backends or any(key.startswith("Composite") for key in backends) or name in BY_CPU


class _OnMps(torch.Tensor):
    """A tensor of the CPU that says it is on MPS. To torch's C++ it is one of ``meta``, which autograd can take."""

    elem: torch.Tensor

    @staticmethod
    def __new__(cls, elem):
        return torch.Tensor._make_wrapper_subclass(
            cls, elem.size(), strides=elem.stride(), storage_offset=elem.storage_offset(), dtype=elem.dtype,
            device="meta", requires_grad=elem.requires_grad,
        )  # fmt: skip

    def __init__(self, elem):
        self.elem = elem

    device = property(lambda self: MPS)
    is_mps = property(lambda self: True)
    is_meta = property(lambda self: False)

    def __repr__(self):
        return f"OnMps({self.elem!r})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise AssertionError(f"{func} outside of PretendedMps")


class _MoveToMeta(TorchFunctionMode):
    """Asks for ``meta`` where MPS is asked for, as C++ knows no MPS here; the mode of dispatch gives what was meant."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func is torch.Tensor.tolist or (func is torch.Tensor.numpy and (kwargs or {}).get("force")):
            args = (args[0].detach().cpu(), *args[1:])
        if func is torch.Tensor.new_tensor and isinstance(args[0], _OnMps):
            func, args, kwargs = torch.tensor, args[1:], {"dtype": args[0].dtype, "device": MPS, **(kwargs or {})}
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[1], tuple | list):
            given = args[1] if isinstance(args[1], tuple) else (args[1],)
            index = (torch.tensor(part) if isinstance(part, list | tuple) else part for part in given)
            args = (args[0], tuple(index), *args[2:])
        if func is torch.Tensor.to:
            args, kwargs = tree_map(_not_mps, (args, kwargs or {}))
        return func(*args, **(kwargs or {}))


class PretendedMps(TorchDispatchMode):
    """Within it, ``device="mps"`` works, and what a real one would refuse is an error.

    Attributes:
        seen: How often each operation ran on the device.
        refused: What the device would refuse, with the place in the package, if ``strict`` is off.
    """

    def __init__(self, strict=True):
        super().__init__()
        self.strict, self.seen, self.refused = strict, Counter(), Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = _name(func)
        if func._can_decompose() and "MPS" not in listed()[name][0]:  # as in inference mode, where nothing else does
            with self:
                return func.decompose(*args, **kwargs)
        given = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)]
        here = [value for value in given if isinstance(value, _OnMps)]
        assert not any(value.is_meta for value in given), f"a tensor without values got into {func}"
        asked = kwargs.get("device")
        asked = None if asked is None else torch.device(asked)
        if asked is not None:
            kwargs["device"] = torch.device("cpu")
            if kwargs.get("pin_memory"):
                kwargs["pin_memory"] = False
        device = (MPS if here else torch.device("cpu")) if asked is None else asked
        if device.type not in ("mps", "meta") and not here:
            return func(*args, **kwargs)
        plain_args, plain_kwargs = tree_map(_plain, (args, kwargs))
        out = func(*plain_args, **plain_kwargs)
        to_host = asked is not None and asked.type == "cpu"
        if not to_host:
            self._check(name, given, here, out)
        if name == "_local_scalar_dense" or to_host:
            return out
        with torch.inference_mode(False):  # a tensor of inference mode could not be detached outside of it
            out = tree_map(lambda value: _OnMps(value) if isinstance(value, torch.Tensor) else value, out)
        return return_and_correct_aliasing(func, args, kwargs, out)

    def _check(self, name, given, here, out):
        self.seen[name] += 1
        made = [value for value in tree_flatten(out)[0] if isinstance(value, torch.Tensor)]
        if any(value.dtype in DOUBLE for value in (*here, *made)):
            self._refuse(f"{name}: double precision")
        if not runs_on_mps(name):
            self._refuse(f"{name}: no kernel")
        apart = [value for value in given if value.ndim > 0 and not isinstance(value, _OnMps)]
        if here and apart and name not in MIXED:
            self._refuse(f"{name}: tensors of both devices")

    def _refuse(self, what):
        own = [f for f in traceback.extract_stack() if "/gaussian_swaying/" in f.filename]
        place = " <- ".join(f"{f.filename.split('/gaussian_swaying/')[-1]}:{f.lineno}" for f in reversed(own[-3:]))
        if self.strict:
            raise NotImplementedError(f"MPS has no {what} ({place})")
        self.refused[f"{what} at {place}"] += 1


@contextmanager
def pretended_mps(strict=True):
    """A :class:`PretendedMps` in which a device may be given as ``mps``."""
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device="mps") asks no real device
    try:
        with PretendedMps(strict) as mode, _MoveToMeta(), patch("torch.backends.mps.is_available", lambda: True):
            yield mode
    finally:
        torch._C._set_only_lift_cpu_tensors(False)


def _name(func):
    overload = "" if func._overloadname == "default" else f".{func._overloadname}"
    return func._schema.name.removeprefix("aten::") + overload


def _not_mps(value):
    return "meta" if isinstance(value, str | torch.device) and str(value) == "mps" else value


def _plain(value):
    return value.elem if isinstance(value, _OnMps) else value
