"""The kernels of `cl/`: their sources, and their arguments, which are given by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

_INCLUDE = re.compile(r'#include "(?P<name>\w+\.h)"')
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_PARAMETER = re.compile(r"(?P<type>.*?)(?P<name>\w+)", re.DOTALL)
_TERM = re.compile(r"(?P<negated>!?)(?P<option>[A-Za-z_]\w*)")
_LEAST_INT, _LARGEST_INT = -(2**31), 2**31 - 1
_SCALARS = {"int": np.int32, "float": np.float32}


def kernel_source(name: str) -> str:
    """Return the text of a file of `cl/`."""
    installed = files("clsas") / "cl" / name
    if installed.is_file():
        return installed.read_text()
    return (Path(__file__).parents[3] / "cl" / name).read_text()  # a source checkout


def whole_source(name: str) -> str:
    """Return the text of a file of `cl/` in which headers replace the lines that include them.

    Each header is put in once. This is not left to the driver, because some drivers cannot read
    paths with spaces, and some cache a program without noticing that a header has changed. The
    compiler's messages still name the original files and lines.
    """
    return "\n".join(_with_headers(name, set()))


def _with_headers(name: str, included: set[str]) -> list[str]:
    text = [f'#line 1 "{name}"']
    for number, line in enumerate(kernel_source(name).splitlines(), start=1):
        include = _INCLUDE.fullmatch(line.strip())
        if include is None:
            text.append(line)
            continue
        if include["name"] not in included:
            included.add(include["name"])
            text += _with_headers(include["name"], included)
        text.append(f'#line {number + 1} "{name}"')
    return text


def kernel_parameters(text: str, name: str, options: Mapping[str, int]) -> dict[str, str]:
    """Return the types of a kernel's parameters by name, in order.

    They are read from the source, because the drivers' own answers are not reliable: Intel's driver
    knows none for a program from its cache, and PoCL renames parameters that have the name of an
    OpenCL function. The parameter list may contain `#if`, `#else` and `#endif`, with conditions of
    build options, `!` and `&&`.

    Parameters
    ----------
    text : str
        Source of the program.
    name : str
        Name of the kernel.
    options : mapping of str to int
        Build options. Missing ones are 0, as they are for the compiler.

    Returns
    -------
    dict of str to str
        The type of a pointer is "buffer"; others are those of the source, such as "int" or
        "float4".

    Raises
    ------
    ValueError
        If the source does not declare the kernel, or its parameter list cannot be read.
    """
    text = _COMMENT.sub("", text)
    found = re.search(rf"__kernel\s+void\s+{name}\s*\(([^)]*)\)", text)
    if found is None:
        raise ValueError(f"the source of kernel {name} does not declare it")
    declarations = " ".join(_compiled_lines(found[1].splitlines(), options))
    parameters = {}
    for declaration in declarations.split(","):
        parameter = _PARAMETER.fullmatch(declaration.strip())
        if parameter is None:
            raise ValueError(f"parameter {declaration.strip()!r} of kernel {name} has no name")
        type_ = parameter["type"].strip()
        parameters[parameter["name"]] = "buffer" if type_.endswith("*") else type_
    return parameters


def _compiled_lines(lines: Sequence[str], options: Mapping[str, int]) -> list[str]:
    """Return the lines that remain after preprocessing."""
    left, conditions = [], []
    for line in lines:
        directive, _, condition = line.strip().partition(" ")
        if directive == "#if":
            conditions.append(_is_true(condition, options))
        elif directive == "#else":
            conditions[-1] = not conditions[-1]
        elif directive == "#endif":
            conditions.pop()
        elif directive.startswith("#"):
            raise ValueError(
                f"parameters of kernels may contain #if, #else and #endif, but not {line!r}"
            )
        elif all(conditions):
            left.append(line)
    return left


def _is_true(condition: str, options: Mapping[str, int]) -> bool:
    for term in condition.split("&&"):
        found = _TERM.fullmatch(term.strip())
        if found is None:
            raise ValueError(f"parameters of kernels cannot depend on {condition!r}")
        if bool(options.get(found["option"], 0)) == bool(found["negated"]):
            return False
    return True


@dataclass(eq=False)
class Kernel:
    """Built kernel, whose arguments are given by the names of its parameters.

    Attributes
    ----------
    name : str
        Name of the kernel, and of its file in `cl/`.
    parameters : dict of str to str
        Types by name, in order; see `kernel_parameters`.
    compiled : pyopencl.Kernel
        The kernel as PyOpenCL runs it.
    """

    name: str
    parameters: dict[str, str]
    compiled: cl.Kernel

    def __post_init__(self) -> None:
        """Check the number of parameters, and set their types."""
        self._converters = {
            parameter: _converter(type_) for parameter, type_ in self.parameters.items()
        }
        if self.compiled.num_args != len(self.parameters):
            raise ValueError(
                f"kernel {self.name} was built with {self.compiled.num_args} parameters, but its "
                f"source declares {len(self.parameters)}: {', '.join(self.parameters)}"
            )
        # PyOpenCL passes numbers more than ten times as fast if it knows their types.
        self.compiled.set_scalar_arg_dtypes(
            [_SCALARS.get(type_) for type_ in self.parameters.values()]
        )

    def ordered(self, arguments: Mapping[str, object]) -> list[Any]:
        """Return arguments in the order of the parameters, converted to their types.

        Raises
        ------
        TypeError
            If an argument is missing, unknown, or not of its parameter's type.
        """
        if arguments.keys() != self.parameters.keys():
            missing = [name for name in self.parameters if name not in arguments]
            unknown = [name for name in arguments if name not in self.parameters]
            problems = [f"needs {', '.join(missing)}"] if missing else []
            problems += [f"does not take {', '.join(unknown)}"] if unknown else []
            raise TypeError(f"kernel {self.name} {' and '.join(problems)}")
        ordered = []
        for name, convert in self._converters.items():
            try:
                ordered.append(convert(arguments[name]))
            except (TypeError, ValueError) as error:
                raise TypeError(
                    f"argument {name} of kernel {self.name} must be {error}, "
                    f"got {arguments[name]!r}"
                ) from None
        return ordered


def _converter(type_: str) -> Callable[[object], object]:
    """Return a function that converts a value to a parameter's type.

    The function raises a TypeError whose message says what is expected, such as "a buffer".
    """
    scalars = {"buffer": _buffer, "int": _int, "float": _float}
    if type_ in scalars:
        return scalars[type_]
    vector = re.fullmatch(r"float([234])", type_)
    if vector is None:
        raise ValueError(f"kernels with parameters of type {type_!r} cannot be run")
    return partial(_vector, int(vector[1]))


def _buffer(value: object) -> object:
    if not isinstance(value, cl.MemoryObjectHolder):
        raise TypeError("a buffer")
    return value


def _int(value: object) -> int:
    if not isinstance(value, (int, np.integer)) or not _LEAST_INT <= value <= _LARGEST_INT:
        raise TypeError("an int of 32 bits")
    return int(value)


def _float(value: object) -> float:
    if not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError("a number")
    return float(value)


def _vector(length: int, value: object) -> np.ndarray:
    vector = np.asarray(value)
    if vector.shape != (length,) or vector.dtype.kind not in "iuf":
        raise TypeError(f"{length} numbers")
    # OpenCL stores a vector of three like one of four.
    converted = np.zeros(4 if length == 3 else length, np.float32)
    converted[:length] = vector
    return converted
