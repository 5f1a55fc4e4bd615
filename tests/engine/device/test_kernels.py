import re
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from clsas.engine.device import kernels
from clsas.engine.device.device import DeviceError
from clsas.engine.device.kernels import kernel_parameters, kernel_source, whole_source
from clsas.engine.factorized.buffers import stage_tables

HERE = Path(kernels.__file__)
FOLDERS = (HERE.parents[2] / "cl", HERE.parents[3] / "cl")
SOURCES = sorted(path.name for folder in FOLDERS for path in folder.glob("*.[ch]*"))

NUMBERS = {"WIDTH": 1, "TAPS": 4, "PHASE_TERMS": 6, "WINDOWS": 1}
TILE = {"TILE_ROWS": 16, "TILE_COLUMNS": 16}
BEAMS = [{"BEAM": beam, "NORMALISE": normalise} for beam, normalise in ((0, 0), (64, 0), (64, 1))]
PIXELS = [beam | {"ALIGNED": aligned} for beam in BEAMS for aligned in (0, 1)]
STAGE = NUMBERS | {"APERTURE_TAPS": 4, "CHUNK": 16}
OPTIONS = {
    "backproject_tiles": [NUMBERS | TILE | options for options in PIXELS],
    "backproject_points": [
        NUMBERS | options | {"CORRECTED": corrected} for options in PIXELS for corrected in (0, 1)
    ],
    "expand_tiles": [NUMBERS | {"BEAM": beam} for beam in (0, 64)],
    "stage": [
        STAGE | {"SHIFTS_GIVEN": given, "RAMP": ramp} for given, ramp in ((0, 0), (1, 0), (1, 1))
    ],
    "first_sheet_stage": [STAGE | {"RAMP": ramp} for ramp in (0, 1)],
    "later_sheet_stage": [STAGE],
    "upsample_lines": [NUMBERS | {"PHASES": 64, "FREQUENCY_SHIFT": shift} for shift in (0, 1)],
    "peak": [NUMBERS | {"CHAINS": 8}],
    "sum_pixels": [{"PHASES": 512, "GROUP": 16, "POINTS": 16}],
}
"""Options of kernels that make their parameters differ."""

TOGETHER = """
#line 1 "together.cl"
__kernel void together(int count, __global const float *given, float factor, float2 pair,
#if THREE && !NONE /* or not */
                       float3 three, float4 four, // and more
#else
                       float other,
#endif
                       __global float *result)
{
    result[0] = count;
    result[1] = given[1];
    result[2] = factor;
    result[3] = pair.y;
#if THREE && !NONE
    result[4] = three.z;
    result[5] = four.w;
#endif
}
"""


@pytest.fixture
def together(platform, monkeypatch):
    """A kernel with parameters of every type, and arguments that fit them."""
    monkeypatch.setattr(kernels, "kernel_source", lambda name: TOGETHER)
    arguments = {
        "count": 3,
        "given": platform.upload(np.arange(3, dtype=np.float32)),
        "factor": 2.5,
        "pair": (1, 7),
        "three": np.array([1.0, 2.0, 3.5]),
        "four": [1, 2, 3, 4.5],
        "result": platform.zeros(24),
    }
    return platform.kernel("together", THREE=1), arguments


def test_arguments_are_given_by_name_in_any_order(platform, together):
    kernel, arguments = together
    arguments |= {"count": np.int64(3), "factor": np.float64(2.5)}
    platform.run(kernel, (1,), **dict(reversed(arguments.items())))
    result = np.empty(6, np.float32)
    cl.enqueue_copy(platform.queue, result, arguments["result"])
    assert result.tolist() == [3, 1, 2.5, 7, 3.5, 4.5]


def test_a_whole_number_may_be_given_for_a_float(platform, together):
    kernel, arguments = together
    platform.run(kernel, (1,), **(arguments | {"factor": 2}))
    result = np.empty(6, np.float32)
    cl.enqueue_copy(platform.queue, result, arguments["result"])
    assert result[2] == 2


WRONG = {
    "a number for a buffer": ("given", 3, "a buffer, got 3"),
    "nothing for a buffer": ("given", None, "a buffer, got None"),
    "an array for a buffer": ("given", [1.0], r"a buffer, got \[1.0\]"),
    "a float for an int": ("count", 3.0, "an int of 32 bits, got 3.0"),
    "too large an int": ("count", 2**31, "an int of 32 bits, got 2147483648"),
    "too small an int": ("count", -(2**31) - 1, "an int of 32 bits, got -2147483649"),
    "text for a float": ("factor", "2.5", "a number, got '2.5'"),
    "an array for a float": ("factor", [2.5], r"a number, got \[2.5\]"),
    "a number for a vector": ("pair", 1.0, "2 numbers, got 1.0"),
    "a vector of another length": ("three", (1, 2, 3, 4), r"3 numbers, got \(1, 2, 3, 4\)"),
    "uneven lists for a vector": ("pair", [[1], [2, 3]], r"2 numbers, got \[\[1\], \[2, 3\]\]"),
    "complex numbers for a vector": ("pair", (1, 2j), r"2 numbers, got \(1, 2j\)"),
}


@pytest.mark.parametrize(("name", "value", "message"), WRONG.values(), ids=WRONG)
def test_an_argument_that_does_not_fit_is_refused(name, value, message, platform, together):
    kernel, arguments = together
    message = f"^argument {name} of kernel together must be {message}$"
    with pytest.raises(TypeError, match=message):
        platform.run(kernel, (1,), **(arguments | {name: value}))


def test_a_buffer_for_a_number_is_refused(platform, together):
    kernel, arguments = together
    with pytest.raises(TypeError, match=r"^argument count of kernel together must be an int"):
        platform.run(kernel, (1,), **(arguments | {"count": arguments["given"]}))


def test_missing_and_unknown_arguments_are_named(platform, together):
    kernel, arguments = together
    missing = {name: value for name, value in arguments.items() if name not in ("pair", "four")}
    with pytest.raises(TypeError, match=r"^kernel together needs pair, four$"):
        platform.run(kernel, (1,), **missing)
    with pytest.raises(TypeError, match=r"^kernel together does not take other, more$"):
        platform.run(kernel, (1,), **arguments, other=1.0, more=2)
    with pytest.raises(TypeError, match=r"^kernel together needs pair, four and does not take"):
        platform.run(kernel, (1,), **missing, more=2)


def test_options_decide_which_parameters_there_are(platform, together):
    plain = platform.kernel("together")
    assert list(plain.parameters) == ["count", "given", "factor", "pair", "other", "result"]
    none = platform.kernel("together", THREE=1, NONE=1)
    assert none.parameters == plain.parameters
    assert together[0].parameters == {
        "count": "int",
        "given": "buffer",
        "factor": "float",
        "pair": "float2",
        "three": "float3",
        "four": "float4",
        "result": "buffer",
    }


@pytest.mark.parametrize("directive", ["#ifdef THREE", "#if THREE > 1", "#if THREE || FOUR"])
def test_directives_that_are_not_understood_are_refused(directive):
    text = f"__kernel void odd(int a,\n{directive}\n int b,\n#endif\n int c) {{}}"
    with pytest.raises(ValueError, match="parameters of kernels"):
        kernel_parameters(text, "odd", {})


def test_a_kernel_that_its_file_does_not_hold_is_refused():
    with pytest.raises(ValueError, match="source of kernel tiles does not declare it"):
        kernel_parameters(whole_source("backproject_tiles.cl"), "tiles", {})


def test_a_count_that_the_compiler_denies_is_refused(platform, together):
    kernel, _ = together
    with pytest.raises(ValueError, match=r"built with 7 parameters, but its source declares 1: a$"):
        kernels.Kernel("together", {"a": "int"}, kernel.compiled)


def test_every_kernel_is_in_the_table():
    declared = [name for name in SOURCES if "__kernel" in kernel_source(name)]
    assert {Path(name).stem for name in declared} == {*OPTIONS, "vector_size"}


def test_the_table_of_bands_has_the_columns_that_kernels_read():
    table = stage_tables(0, 1, 1, 1, ramps=False)["bands0"]
    (struct,) = re.findall(r"typedef struct \{([^}]*)\} Band;", kernel_source("stages.h"))
    columns = re.sub(r"/\*.*?\*/|\bint\b", "", struct).replace(",", ";").split(";")
    assert len([name for name in columns if name.strip()]) == table.shape[-1]


@pytest.mark.slow
@pytest.mark.watches("cl", "clsas/engine/device")
@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")
@pytest.mark.parametrize("name", OPTIONS)
def test_parameters_are_those_that_the_compiler_finds(name, platform):
    """Drivers report parameters on request, but not for a program from their cache.

    PoCL's headers rename parameters with the name of an OpenCL function, such as `length`.
    """
    info, text = cl.kernel_arg_info, whole_source(f"{name}.cl")
    for options in OPTIONS[name]:
        definitions = [f"-D{option}={value}" for option, value in options.items()]
        program = cl.Program(platform.context, text)
        program.build(["-cl-kernel-arg-info", *definitions], cache_dir=False)
        compiled = cl.Kernel(program, name)
        found = {}
        for number in range(compiled.num_args):
            type_ = compiled.get_arg_info(number, info.TYPE_NAME)
            parameter = compiled.get_arg_info(number, info.NAME).removeprefix("_cl_")
            found[parameter] = "buffer" if type_.endswith("*") else type_
        parameters = kernel_parameters(text, name, options)
        assert list(parameters.items()) == list(found.items())


def test_headers_are_put_in_once_each():
    text = whole_source("backproject_tiles.cl")
    assert text.count("typedef float vfloat;") == 1
    assert "#include" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


def test_a_failed_build_names_the_header(platform, monkeypatch):
    files = {
        "broken.cl": '#include "part.h"\n__kernel void broken(__global float *x) { x[0] = ONE; }',
        "part.h": "/* A header. */\n#define ONE 1.0f\nint 3x;",
    }
    monkeypatch.setattr(kernels, "kernel_source", files.get)
    with pytest.raises(DeviceError, match=r"part\.h:3"):
        platform.kernel("broken", WIDTH=1)


def test_the_vector_widths_give_their_values(device, monkeypatch):
    """Uploads, a build and a run: the smallest job, through the header all kernels share."""
    width = device.info.width
    source = """#include "phases.h"
        __kernel void turn(__global const float *t, __global const float *polynomials,
                           __global float *sine, __global float *cosine)
        {
            const int i = get_global_id(0) * WIDTH;
            vfloat s, c;
            sine_and_cosine(LOAD(t + i), polynomials, &s, &c);
            STORE(s, sine + i);
            STORE(c, cosine + i);
        }"""
    monkeypatch.setattr(
        kernels, "kernel_source", lambda name: source if name == "turn.cl" else kernel_source(name)
    )
    kernel = device.kernel("turn", WIDTH=width, PHASE_TERMS=kernels.PRECISE_PHASE_TERMS)
    rng = np.random.default_rng(1)
    t = np.concatenate([rng.uniform(-0.5, 0.5, 3000), rng.uniform(-3e3, 3e3, 1000), np.zeros(96)])
    t = t.astype(np.float32)
    t[-9:] = np.arange(-4, 5) / 4
    sine, cosine = np.empty_like(t), np.empty_like(t)
    results = {"sine": device.buffer(t.nbytes), "cosine": device.buffer(t.nbytes)}
    polynomials = device.upload(kernels.sine_and_cosine(kernels.PRECISE_PHASE_TERMS))
    size = (len(t) // width,)
    device.run(kernel, size, t=device.upload(t), polynomials=polynomials, **results)
    cl.enqueue_copy(device.queue, sine, results["sine"])
    cl.enqueue_copy(device.queue, cosine, results["cosine"])
    angle = 2 * np.pi * t.astype(np.float64)
    assert np.abs(sine - np.sin(angle)).max() <= 2e-6
    assert np.abs(cosine - np.cos(angle)).max() <= 2e-6


def test_the_sources_are_found():
    assert {"vectors.h", "backproject_tiles.cl"} <= set(SOURCES)


@pytest.mark.parametrize("name", SOURCES)
def test_no_kernel_needs_double_precision(name):
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", kernel_source(name), flags=re.DOTALL)
    assert re.search("__kernel|__global|vfloat", code)
    assert not re.search(r"\b(double\d*|cl_khr_fp64|as_double\d*|convert_double\d*)\b", code)
    # A literal without its f is a double.
    assert not re.findall(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+[eE])(?:[eE]?[+-]?\d+)?(?![\w.])", code)


@pytest.mark.parametrize("terms", kernels.PHASE_TERMS)
def test_polynomials_are_sine_and_cosine(terms):
    r = np.random.default_rng(terms).uniform(-0.5, 0.5, 20000)
    coefficients = kernels.sine_and_cosine(terms).astype(np.float64)
    sine, cosine = (np.polyval(each, r**2) for each in coefficients)
    off = cosine + 1j * r * sine - np.exp(2j * np.pi * r)
    rms = np.sqrt(np.mean(np.abs(off) ** 2))
    assert rms == pytest.approx(kernels.phase_error(terms), rel=0.1)
    assert np.abs(off).max() <= 5 * rms


@pytest.mark.parametrize("most", [kernels.FACTORIZED_PHASE_SHARE, kernels.EXACT_PHASE_SHARE])
def test_an_image_has_as_many_terms_as_it_needs(most):
    for error_db in np.arange(-85, -1):
        terms = kernels.phase_terms_within(error_db, most)
        share = (kernels.phase_error(terms) / 10 ** (error_db / 20)) ** 2
        assert share <= most
        fewer = [n for n in kernels.PHASE_TERMS if n < terms]
        assert all(kernels.phase_error(n) ** 2 > most * 10 ** (error_db / 10) for n in fewer)
