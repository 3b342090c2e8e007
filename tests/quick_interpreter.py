"""Triton's interpreter in less than half the time: without work that it repeats or throws away, and with the same bits.

It wraps inner functions of the Triton that constraints.txt pins, and ``mpm/test_interpreter.py`` compares it with plain
Triton. If a new version breaks it, call :func:`quicken` nowhere: the tests pass without it, only later.
"""

import importlib.util
import inspect
import math
import os


def quicken(changes):
    """Patch the interpreter, if kernels are interpreted here, until ``changes`` (a ``MonkeyPatch``) is undone."""
    if importlib.util.find_spec("triton") is None or os.environ.get("TRITON_INTERPRET") != "1":
        return
    import triton.language as tl
    from triton.language import core
    from triton.runtime import interpreter

    semantic, tensor = interpreter.TritonSemantic, tl.tensor

    # The language is patched once per launch and module, not in every call of a device function.
    launch, patch, patched = interpreter.GridExecutor.__call__, interpreter._patch_lang, set()

    def quick_launch(self, *args, **kwargs):
        patched.clear()
        return launch(self, *args, **kwargs)

    def quick_call(self, *args, **kwargs):
        module = id(self.fn.__globals__)
        if module not in patched:
            patch(self.fn)
            patched.add(module)
        return self.rewrite()(*args, **kwargs)

    changes.setattr(interpreter.GridExecutor, "__call__", quick_launch)
    changes.setattr(interpreter.InterpretedFunction, "__call__", quick_call)

    # Types that are equal are made once: their names, shapes and numpy's types.
    numpy_type, numpy_types = interpreter._get_np_dtype, {}
    unwrap, fill, blocks, shapes = core._unwrap_if_constexpr, core.block_type.__init__, {}, {}

    def quick_numpy_type(of):
        if of.name not in numpy_types:
            numpy_types[of.name] = numpy_type(of)
        return numpy_types[of.name]

    def quick_unwrap(value):
        return value if value.__class__ in plain else unwrap(value)

    def quick_block(self, element_ty, shape):
        key = (element_ty.name, tuple(size.value if isinstance(size, tl.constexpr) else size for size in shape))
        if key not in blocks:
            fill(self, element_ty, shape)
            self.shape = shapes.setdefault(key[1], self.shape)  # one object for each shape
            blocks[key] = self.__dict__.copy()
        else:
            self.__dict__.update(blocks[key], element_ty=element_ty)

    def quick_tensor(self, handle, type):
        self.handle, self.type, self.dtype = handle, type, type.scalar
        shape = type.shape if type.is_block() else ()
        if id(shape) not in sizes:
            sizes[id(shape)] = (tl.constexpr(math.prod(shape)), tl.tuple([tl.constexpr(size) for size in shape]), shape)
        self.numel, self.shape, _ = sizes[id(shape)]

    plain, sizes = {tensor, int, float, bool}, {}
    changes.setattr(interpreter, "_get_np_dtype", quick_numpy_type)
    changes.setattr(core, "_unwrap_if_constexpr", quick_unwrap)
    changes.setattr(core.block_type, "__init__", quick_block)
    changes.setattr(tensor, "__init__", quick_tensor)

    # Operands of one type and shape are what they are converted to, and so is a number that was converted once.
    convert, broadcast, constants = semantic.binary_op_type_checking_impl, semantic.broadcast_impl_value, {}
    whole, floats = {tl.int32.name, tl.int64.name}, {tl.float32.name, tl.float64.name}
    kinds = {tl.int1.name, *whole, *floats}

    def quick_convert(self, lhs, rhs, lhs_pointer=False, rhs_pointer=False, arithmetic=True, division=False):
        if lhs.__class__ is tensor and rhs.__class__ is tensor:
            kind, other = lhs.dtype.name, rhs.dtype.name
            fit = kind in kinds if kind == other else lhs_pointer and lhs.dtype.is_ptr() and other in whole
            if fit and same_shape(lhs.type, rhs.type):
                return lhs, rhs
        elif arithmetic and lhs.__class__ is tensor and converts(rhs, lhs.dtype.name):
            return lhs, constant(self, lhs, rhs)
        elif arithmetic and rhs.__class__ is tensor and converts(lhs, rhs.dtype.name):
            return constant(self, rhs, lhs), rhs
        return convert(self, lhs, rhs, lhs_pointer, rhs_pointer, arithmetic, division)

    def converts(number, kind):
        return (number.__class__ is float and kind in floats) or (number.__class__ is int and kind in whole)

    def constant(self, beside, number):
        key = (number, beside.type.name)
        if key not in constants:
            constants[key] = convert(self, beside, number)[1]
            constants[key].handle.data.setflags(write=False)
        return constants[key]

    def quick_broadcast(self, lhs, rhs):
        return (lhs, rhs) if same_shape(lhs.type, rhs.type) else broadcast(self, lhs, rhs)

    def same_shape(a, b):
        return a.is_block() == b.is_block() and (not a.is_block() or a.shape is b.shape)

    changes.setattr(semantic, "binary_op_type_checking_impl", quick_convert)
    changes.setattr(semantic, "broadcast_impl_value", quick_broadcast)
    if not interpreter.interpreter_builder.options.debug:  # then the result of the check is thrown away
        changes.setattr(semantic, "binary_op_sanitize_overflow_impl", lambda self, lhs, rhs, binary_op: None)

    # Members of the language are looked up once, and called without a copy of their named arguments.
    members = {}

    def quick_builtins(package, builder, scope):
        if package not in members:  # then nothing of it is patched
            members[package] = [pair for pair in inspect.getmembers(package) if core.is_builtin(pair[1])]
        for name, member in members[package]:
            if getattr(package, name) is member:
                quick_member(package, name, member, scope)

    def quick_member(where, name, member, scope):
        def called(*args, **kwargs):
            kwargs["_semantic"] = interpreter.interpreter_semantic
            return member(*args, **kwargs)

        scope.set_attr(where, name, called)

    changes.setattr(interpreter, "_patch_builtin", quick_builtins)
