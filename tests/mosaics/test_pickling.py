"""Mosaics, patches and devices that are pickled and used in another process."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
from cases import along_x, lines_over

import clsas
from clsas.engine.data.grid import Grid
from clsas.engine.device import device as module
from clsas.engine.device.device import DeviceError, list_devices, open_device

GRID = Grid.plane((-1, 1, 40), (20, 22, 33))
LINES = lines_over(GRID, along_x(32, 0.05), carrier_hz=1e5, step_m=0.01)
READ = """
import pickle, sys
mosaic = pickle.load(sys.stdin.buffer)
pickle.dump((len(mosaic.finished), mosaic.image()), sys.stdout.buffer)
"""


def formed_elsewhere(mosaic):
    """Return the finished patches and the image of a mosaic, from another process."""
    done = subprocess.run(
        [sys.executable, "-c", READ], input=pickle.dumps(mosaic), capture_output=True, check=True
    )
    return pickle.loads(done.stdout)


@pytest.mark.slow
def test_a_mosaic_goes_to_another_process(platform):
    mosaic = clsas.mosaic(LINES, GRID, patches=(2, 2), device=open_device(platform.info.index))
    finished, image = formed_elsewhere(mosaic)
    assert finished == 0
    np.testing.assert_array_equal(image, mosaic.image())
    np.testing.assert_array_equal(image.grid.positions_m(), GRID.positions_m())


@pytest.mark.slow
def test_another_process_goes_on_with_the_store(tmp_path):
    clsas.save(tmp_path / "lines.h5", LINES)
    wish = {"patches": (2, 2), "memory_bytes": 64 << 20}  # for one patch at a time
    mosaic = clsas.mosaic(tmp_path / "lines.h5", GRID, tmp_path / "image.zarr", **wish)
    patch = next(iter(mosaic))
    read = pickle.loads(pickle.dumps(patch))
    np.testing.assert_array_equal(read.image, patch.image)
    finished, image = formed_elsewhere(mosaic)
    assert 1 <= finished < 4
    assert len(clsas.Store.opened(tmp_path / "image.zarr").records()) == 4
    np.testing.assert_array_equal(image, clsas.Store.opened(tmp_path / "image.zarr").image())


@pytest.mark.slow
def test_a_mosaic_goes_to_a_worker_of_dask():
    pytest.importorskip("distributed")
    pytest.importorskip("cryptography")
    from clsas.mosaics.workers import local_client

    mosaic = clsas.mosaic(LINES, GRID, patches=(2, 2))
    with local_client(1) as client:
        image = client.submit(clsas.Mosaic.image, mosaic).result(timeout=300)
    np.testing.assert_array_equal(image, mosaic.image())


@pytest.mark.slow
def test_a_mosaic_with_a_client_says_why_it_does_not_pickle(tmp_path):
    pytest.importorskip("distributed")
    pytest.importorskip("cryptography")
    from clsas.mosaics.workers import local_client

    clsas.save(tmp_path / "lines.h5", LINES)
    with local_client(1) as client:
        mosaic = clsas.mosaic(tmp_path / "lines.h5", GRID, tmp_path / "image.zarr", client=client)
        with pytest.raises(TypeError, match="a mosaic with a client cannot be pickled"):
            pickle.dumps(mosaic)


def test_a_device_is_opened_by_its_name(platform, monkeypatch):
    opened = open_device(platform.info.index)
    assert pickle.loads(pickle.dumps(opened)) is opened
    pickled = pickle.dumps(opened)
    known = list_devices()[0]
    monkeypatch.setattr(module, "list_devices", lambda: [known])
    if known.label != opened.info.label:
        with pytest.raises(DeviceError, match=r"pickled device .* is not on this machine, which"):
            pickle.loads(pickled)
