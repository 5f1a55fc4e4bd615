"""Every OpenCL platform here, and every way in which a CPU's kernels can be built."""

from functools import cache

import pytest

from clsas.opencl.device import Device, list_devices, open_device
from clsas.trials.selftest import driven, other_builds


def _named(ways, infos):
    return {
        f"{infos[index].platform.replace('(', ' ').split()[0]}-{width}{'-permute' * permute}": (
            index,
            width,
            permute,
        )
        for index, width, permute in ways
    }


def _variants():
    """(index, lanes, permute) of one device per platform, and of one CPU driven in every way."""
    infos = list_devices()
    first = {info.platform: info for info in reversed(infos)}.values()
    own = _named([(info.index, info.width, info.permute) for info in first], infos)
    # Of the CPUs' compilers PoCL's is the fastest.
    cpus = sorted((info for info in first if info.kind == "cpu"), key=lambda i: i.platform)[-1:]
    forced = _named(
        [(info.index, *build) for info in cpus for build in other_builds(info)],
        infos,
    )
    # Without any device the tests fail, with the message that says how to get one.
    return own or {"none": (None, None, None)}, forced


@cache
def variant(index, width, permute):
    """A device that is driven in a given way; its kernels are built once."""
    return driven(open_device(index), width, permute)


OWN, OTHERS = _variants()
_ALL = OWN | OTHERS


@pytest.fixture(params=OWN.values(), ids=OWN.keys(), scope="session")
def platform(request):
    """Every platform's first device, as it is used."""
    return variant(*request.param)


@pytest.fixture(params=_ALL.values(), ids=_ALL.keys(), scope="session")
def device(request):
    """Every platform's first device, and a CPU also with other vector widths."""
    return variant(*request.param)


@pytest.fixture
def buffer_bytes(monkeypatch):
    """Sizes of all buffers that are made, as they are."""
    sizes = []

    def recorded(make):
        def made(*args):
            buffer = make(*args)
            sizes.append(buffer.size)
            return buffer

        return made

    for name in ("buffer", "share", "upload", "zeros"):
        monkeypatch.setattr(Device, name, recorded(getattr(Device, name)))
    return sizes
