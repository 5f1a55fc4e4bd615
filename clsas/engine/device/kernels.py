"""The kernels of `cl/`: their sources, their arguments, and their polynomials for sine and cosine.

Arguments are given by name.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.engine.data.decibels import amplitude

_INCLUDE = re.compile(r'#include "(?P<name>\w+\.h)"')
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_PARAMETER = re.compile(r"(?P<type>.*?)(?P<name>\w+)", re.DOTALL)
_TERM = re.compile(r"(?P<negated>!?)(?P<option>[A-Za-z_]\w*)")
_LEAST_INT, _LARGEST_INT = -(2**31), 2**31 - 1
_SCALARS = {"int": np.int32, "float": np.float32}
_VECTORS = {"float2": 2, "float3": 3, "float4": 4}

PHASE_TERMS = (4, 5, 6)
"""Available numbers of terms of the polynomials for sine and cosine. Their relative rms errors are
-61, -92 and -126 dB."""
PRECISE_PHASE_TERMS = 7
"""Number of terms with which the error is that of single precision. It is used for phases on which
several parts of an image depend: those of upsampling and of stages."""
FACTORIZED_PHASE_SHARE, EXACT_PHASE_SHARE = 0.03, 0.08
"""Shares of the error power of an image that polynomials may add. Exact images may have the larger
one, because the errors of their many channels average out."""
_PHASES = (np.arange(2000) + 0.5) / 2000 - 0.5  # cycles


def kernel_source(name: str) -> str:
    """Return the text of a file of `cl/`."""
    installed = files("clsas") / "cl" / name
    if installed.is_file():
        return installed.read_text()
    return (Path(__file__).parents[3] / "cl" / name).read_text()  # a source checkout


def whole_source(name: str, included: set[str] | None = None) -> str:
    """Return the text of a file of `cl/` in which headers replace the lines that include them.

    Each header is put in once; `included` are the names of those that are already in. This is not
    left to the driver, because some drivers cannot read paths with spaces, and some cache a program
    without noticing that a header has changed. The compiler's messages still name the original
    files and lines.
    """
    included = set() if included is None else included
    text = [f'#line 1 "{name}"']
    for number, line in enumerate(kernel_source(name).splitlines(), start=1):
        include = _INCLUDE.fullmatch(line.strip())
        if include is None:
            text.append(line)
            continue
        if include["name"] not in included:
            included.add(include["name"])
            text.append(whole_source(include["name"], included))
        text.append(f'#line {number + 1} "{name}"')
    return "\n".join(text)


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
        """Check number and types of the parameters, and hand the types to PyOpenCL."""
        for type_ in self.parameters.values():
            if type_ != "buffer" and type_ not in _SCALARS and type_ not in _VECTORS:
                raise ValueError(f"kernels with parameters of type {type_!r} cannot be run")
        if self.compiled.num_args != len(self.parameters):
            raise ValueError(
                f"kernel {self.name} was built with {self.compiled.num_args} parameters, but its "
                f"source declares {len(self.parameters)}: {', '.join(self.parameters)}"
            )
        # PyOpenCL passes numbers more than ten times as fast if it knows their types.
        self.compiled.set_scalar_arg_dtypes(
            [_SCALARS.get(type_) for type_ in self.parameters.values()]
        )

    def ordered(self, arguments: Mapping[str, Any]) -> list[Any]:
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
        ordered: list[Any] = []
        for name, type_ in self.parameters.items():
            value: Any = arguments[name]
            converted: Any = None
            if type_ == "buffer":
                expected = "a buffer"
                if isinstance(value, cl.MemoryObjectHolder):
                    converted = value
            elif type_ == "int":
                expected = "an int of 32 bits"
                if isinstance(value, (int, np.integer)) and _LEAST_INT <= value <= _LARGEST_INT:
                    converted = int(value)
            elif type_ == "float":
                expected = "a number"
                if isinstance(value, (int, float, np.integer, np.floating)):
                    converted = float(value)
            else:
                length = _VECTORS[type_]
                expected = f"{length} numbers"
                with contextlib.suppress(ValueError):  # of lists within a list
                    value = np.asarray(value)
                    if value.shape == (length,) and value.dtype.kind in "iuf":
                        # OpenCL stores a vector of three like one of four.
                        converted = np.zeros(4 if length == 3 else length, np.float32)
                        converted[:length] = value
            if converted is None:
                raise TypeError(
                    f"argument {name} of kernel {self.name} must be {expected}, "
                    f"got {arguments[name]!r}"
                )
            ordered.append(converted)
        return ordered


@functools.cache
def sine_and_cosine(terms: int) -> NDArray[np.float32]:
    """Return the coefficients of `cl/phases.h`, float32 [2, terms], highest power first.

    They are least-squares fits of sin(2 pi r)/r and cos(2 pi r) by powers of r^2, where r is the
    phase in cycles, from -0.5 to 0.5.
    """
    powers = _powers(terms)
    sine = np.linalg.lstsq(_PHASES[:, None] * powers, np.sin(2 * np.pi * _PHASES), rcond=None)[0]
    cosine = np.linalg.lstsq(powers, np.cos(2 * np.pi * _PHASES), rcond=None)[0]
    return np.stack([sine, cosine]).astype(np.float32)


@functools.cache
def phase_error(terms: int) -> float:
    """Return the relative rms error of exp(j 2 pi r) by these polynomials."""
    sine, cosine = sine_and_cosine(terms).astype(np.float64) @ _powers(terms).T
    found = cosine + 1j * _PHASES * sine
    return float(np.sqrt(np.mean(np.abs(found - np.exp(2j * np.pi * _PHASES)) ** 2)))


def phase_terms_within(error_db: float, share: float) -> int:
    """Return the number of terms for an image with a given relative rms error, dB.

    `share` is the share of the error power that the polynomials may add.
    """
    most = np.sqrt(share) * amplitude(error_db)
    found = (terms for terms in PHASE_TERMS if phase_error(terms) <= most)
    return next(found, PHASE_TERMS[-1])


def _powers(terms: int) -> NDArray[np.float64]:
    return (_PHASES**2)[:, None] ** np.arange(terms)[::-1]
