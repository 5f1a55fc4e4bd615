import pytest
from studies import tuning
from studies.scaling import scaled

from clsas.engine.device import buffers
from clsas.engine.device.device import open_device
from clsas.engine.factorized import stages


@pytest.mark.watches("scripts/studies")
def test_every_constant_takes_turns_and_keeps_its_value(monkeypatch):
    monkeypatch.setattr(tuning, "FACTORS", (1.0, 2.0))
    monkeypatch.setattr(tuning, "_RUNS", 1)
    device = open_device()
    before = {str(each): each.value for each in tuning.constants(device)}
    rows = list(tuning.changes(device, scaled(256)))
    assert {str(each): each.value for each in tuning.constants(device)} == before
    assert len(rows) == 2 * len(before)
    for row in rows:
        assert len(row) == len(tuning.COLUMNS)
        assert float(row[2]) > 0
        assert float(row[4]) > 0
    # The usual value is compared with itself.
    assert [row[3] for row in rows[::2]] == ["1.00"] * len(before)
    assert [row[5] for row in rows[::2]] == ["1.00"] * len(before)


def test_a_device_of_one_lane_has_work_groups_to_tune(monkeypatch):
    import dataclasses

    device = open_device()
    info = dataclasses.replace(device.info, width=1, kind="gpu")
    single = dataclasses.replace(device, info=info, _kernels={})
    named = {(each.module.__name__, each.name) for each in tuning.constants(single)}
    assert (stages.__name__, "_GROUP") in named
    assert (buffers.__name__, "_LINE_ITEMS") in named
    assert ("clsas.engine.factorized.costs", "_BATCH_BYTES") in named
