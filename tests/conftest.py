"""Every OpenCL platform here, and every way in which a CPU's kernels can be built."""

import dataclasses
from functools import cache

import pytest

from clsas.device import list_devices, open_device

# What other devices have: float lanes (one is what runs on GPUs), and whether kernels may permute.
FORCED = ((1, False), (4, False), (8, False), (16, False))


def _variants():
    """(index, lanes, permute) of one device per platform, and of one CPU driven in every way."""
    first = {info.platform: info for info in reversed(list_devices())}
    own = [(info.index, info.width, info.permute) for info in first.values()]
    # Of the CPUs' compilers PoCL's is the fastest.
    cpus = sorted(name for name, info in first.items() if info.kind == "cpu")[-1:]
    forced = [(first[name].index, *way) for name in cpus for way in FORCED]
    names = {info.index: info.platform.replace("(", " ").split()[0] for info in first.values()}
    variants = {
        f"{names[index]}-{width}{'-permute' * permute}": (index, width, permute)
        for index, width, permute in own + forced
    }
    # Without any device the tests fail, with the message that says how to get one.
    return variants or {"none": (None, None, None)}


@cache
def variant(index, width, permute):
    """A device that is driven in a given way; its kernels are built once."""
    device = open_device(index)
    info = dataclasses.replace(device.info, width=width, permute=permute)
    if info == device.info:
        return device
    return dataclasses.replace(device, info=info, _kernels={})


_VARIANTS = _variants()


@pytest.fixture(params=_VARIANTS.values(), ids=_VARIANTS.keys(), scope="session")
def device(request):
    """Every platform's first device, and a CPU also with other vector widths."""
    return variant(*request.param)
