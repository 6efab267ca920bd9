"""Content keys: a name for a run that changes when anything changes that the run depends on.

A value is described by text that is the same in every session and process: no addresses, no order of sets, no pickles.
A function is described by its source (without comments), its defaults, and what it refers to: closure, module globals,
and whatever these refer to in turn. Functions, classes and modules of installed packages are known by name only, and a
module of one's own, used as `module.name`, by the whole of its file.
"""

from __future__ import annotations

import ast
import copyreg
import inspect
import re
import site
import sys
import sysconfig
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import partial
from hashlib import sha256
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

PLAIN = (bool, int, float, complex, str, bytes)
ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def digest(*parts: Any) -> str:
    """Return 32 hexadecimal digits that stand for values, in this order; texts go in as they are."""
    text = "\n".join(part if isinstance(part, str) else describe(part) for part in parts)
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def describe(value: Any) -> str:
    """Return the description of a value or function."""
    return _Description(getattr(getattr(value, "func", value), "__module__", None)).of(value)


class _Description:
    """One description in the making; `own` is a module that counts as the user's wherever it lies."""

    def __init__(self, own: str | None):
        self.own = own
        self.met: dict[int, tuple[int, Any]] = {}  # the values are kept, so that no id is used twice

    def of(self, value: Any) -> str:
        if value is None or type(value) in PLAIN:
            return (_file(Path(value)) if type(value) is str and value.endswith(".fmu") else None) or repr(value)
        if isinstance(value, np.generic):
            return f"{value.dtype.str}:{value.item()!r}"
        if isinstance(value, Path):
            return _file(value) or f"path {value.as_posix()!r}"
        if isinstance(value, Enum):
            return f"{_name(type(value))}.{value.name}"
        if id(value) in self.met:
            return f"#{self.met[id(value)][0]}"
        self.met[id(value)] = (len(self.met), value)
        return self._compound(value)

    def _compound(self, value: Any) -> str:
        if isinstance(value, np.ndarray) and value.dtype != object:
            shown = np.ascontiguousarray(value)
            return f"array {shown.dtype.str} {shown.shape} {sha256(shown.tobytes()).hexdigest()}"
        if isinstance(value, ModuleType):
            path = getattr(value, "__file__", None)
            return (
                f"module {value.__name__} {'' if self._installed(value.__name__) else _file(Path(path or '.')) or ''}"
            )
        if isinstance(value, FunctionType):
            return self._function(value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, MethodType):
            return f"method {value.__name__} of {self.of(value.__self__)}"
        if isinstance(value, BuiltinFunctionType):
            return f"builtin {value.__module__}.{value.__qualname__}"
        if isinstance(value, partial):
            return f"partial({self.of(value.func)}, {self.of(value.args)}, {self.of(value.keywords)})"
        if isinstance(value, (list, tuple, np.ndarray)):
            return f"{type(value).__name__}[{', '.join(self.of(item) for item in value)}]"
        if isinstance(value, (set, frozenset)):
            return f"set[{', '.join(sorted(_Description(self.own).of(item) for item in value))}]"
        if isinstance(value, Mapping):
            keys = sorted(value, key=lambda key: (type(key).__name__, str(key)))
            return f"{type(value).__name__}{{{', '.join(f'{self.of(key)}: {self.of(value[key])}' for key in keys)}}}"
        if is_dataclass(value):
            shown = {item.name: getattr(value, item.name) for item in fields(value)}
            return f"{self.of(type(value))}({', '.join(f'{name}={self.of(shown[name])}' for name in shown)})"
        return self._object(value)

    def _object(self, value: Any) -> str:
        """Describe an object by what it would be pickled as; by its `repr` where it cannot be."""
        if callable(getattr(value, "serialize", None)) and type(value).__module__.startswith("casadi"):
            return f"{_name(type(value))} {sha256(value.serialize().encode()).hexdigest()}"
        kind = self.of(type(value))
        if type(value).__module__.startswith("ctmhe.") and hasattr(value, "advance") and "model" in vars(value):
            # a plant: where it stands at the moment is no part of what it is
            return f"{kind} {self.of({name: part for name, part in vars(value).items() if not name.startswith('_')})}"
        try:
            reduce = copyreg.dispatch_table.get(type(value))
            reduced = reduce(value) if reduce else value.__reduce_ex__(4)
        except Exception:  # whatever a foreign class raises when it cannot be pickled
            return f"{kind} {ADDRESS.sub('', repr(value))}"
        if isinstance(reduced, str):  # pickled by name
            reduced = vars(value) if hasattr(value, "__dict__") else reduced
            return f"{kind} {self.of(reduced)}"
        made, arguments, *rest = reduced
        parts = [list(part) if isinstance(part, Iterator) else part for part in rest]
        return f"{kind} {self.of(made)} {self.of(arguments)} {self.of(parts)}"

    def _function(self, function: FunctionType) -> str:
        name = _name(function)
        if self._installed(function.__module__):
            return f"function {name}"
        parts = [_source(function), self.of(function.__defaults__), self.of(function.__kwdefaults__)]
        for variable, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            try:
                parts.append(f"{variable}={self.of(cell.cell_contents)}")
            except ValueError:  # not filled yet
                parts.append(f"{variable}=?")
        for variable in _names(function.__code__):
            if variable in function.__globals__:
                parts.append(f"{variable}={self.of(function.__globals__[variable])}")
        return f"function {name} {{{'; '.join(parts)}}}"

    def _class(self, kind: type) -> str:
        if self._installed(kind.__module__):
            return f"class {_name(kind)}"
        parts = [self.of(base) for base in kind.__bases__]
        for name, value in sorted(vars(kind).items()):
            inner = value.__func__ if isinstance(value, (staticmethod, classmethod)) else value
            inner = inner.fget if isinstance(inner, property) else getattr(inner, "func", inner)
            made = isinstance(inner, FunctionType) and inner.__code__.co_filename.startswith("<")  # by dataclass()
            if (name.startswith("__") and not isinstance(inner, FunctionType)) or made:
                continue
            plain = inner is None or isinstance(
                inner, (FunctionType, bool, int, float, str, tuple, list, dict, np.ndarray)
            )
            parts.append(f"{name}={self.of(inner) if plain else _name(type(inner))}")
        return f"class {_name(kind)} {{{'; '.join(parts)}}}"

    def _installed(self, module: str | None) -> bool:
        """Return whether a module belongs to Python, to this library or to an installed package."""
        if module in (self.own, "__main__"):
            return False
        if module is None or module.partition(".")[0] == "ctmhe":
            return True
        path = getattr(sys.modules.get(module), "__file__", None)
        if path is None:  # built in, or made at run time
            return module in sys.builtin_module_names or module not in sys.modules
        return Path(path).resolve().is_relative_to(_root()) or any(Path(path).is_relative_to(p) for p in _places())


def _root() -> Path:
    return Path(np.__file__).resolve().parents[1]


def _places() -> Sequence[str]:
    paths = sysconfig.get_paths()
    return [paths["stdlib"], paths["purelib"], paths["platlib"], *site.getsitepackages()]


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _file(path: Path) -> str | None:
    """Return a file's content as a digest, None where there is no such file."""
    try:
        return f"file {sha256(path.read_bytes()).hexdigest()}" if path.is_file() else None
    except OSError:
        return None


def _source(function: FunctionType) -> str:
    """Return a function's source without comments; its byte code for a lambda, whose source is a piece of a line."""
    if function.__name__ != "<lambda>":
        try:
            return ast.unparse(ast.parse(textwrap.dedent(inspect.getsource(function))))
        except (OSError, TypeError, SyntaxError):
            pass
    return _code(function.__code__)


def _code(code: CodeType) -> str:
    constants = [_code(item) if isinstance(item, CodeType) else repr(item) for item in code.co_consts]
    return f"{code.co_code.hex()} {constants} {code.co_names} {code.co_varnames}"


def _names(code: CodeType) -> list[str]:
    """Return the names that a function, or a function inside it, may look up in its module."""
    names = set(code.co_names)
    for item in code.co_consts:
        if isinstance(item, CodeType):
            names.update(_names(item))
    return sorted(names)
