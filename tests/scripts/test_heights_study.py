"""The study of the time that heights take runs, and its heights are right."""

import pytest
from studies import relief

from clsas.selftest import cases


@pytest.mark.watches("scripts/studies", "scripts/bench")
def test_heights_err_as_much_as_they_say(monkeypatch):
    monkeypatch.setattr(cases, "HEIGHTS_CASES", {"small": cases.Dunes(128, (-1.0, 1.0))})
    (row,) = relief.rows("pocl")
    found = dict(zip(relief.COLUMNS, row, strict=True))
    assert found["pixels"] == "128 x 128"
    assert float(found["valid %"]) > 70
    assert float(found["rms error mm"]) < 1.5 * float(found["rms deviation mm"])
    parts = [float(found[name]) for name in ("image s", "sweep s", "refinement s")]
    assert min(parts) > 0
    assert float(found["heights over image"]) == pytest.approx(sum(parts[1:]) / parts[0], rel=0.3)
