"""The whole chain: the wreck, recorded by an array on an unknown track."""

import pytest
from studies import blurred_wreck

from clsas.engine.data.validate import ClsasWarning
from clsas.selftest import wreck

pytest.importorskip("matplotlib")


@pytest.mark.watches("scripts/studies")
def test_the_chain_restores_what_the_true_track_shows(tmp_path):
    recording = blurred_wreck.recorded()
    few = pytest.warns(ClsasWarning, match="navigate: .* fewer than 8 reflectors")
    with pytest.warns(ClsasWarning, match="inspect: "), few:
        images = blurred_wreck.Images.of(recording, tmp_path)
    true, before = images.true, images.given
    shadow = wreck.Shadow(wreck.scene())
    ideal, measured = (blurred_wreck.Measures.of(each, shadow) for each in (true, images.processed))
    lost_db = ideal.peak_db - measured.peak_db
    assert abs(lost_db) < 1
    assert abs(ideal.contrast_db - measured.contrast_db) < 1
    for name in ("azimuth_m", "range_m"):  # 1 dB is a factor of 1.26
        assert getattr(ideal, name) / 1.26 < getattr(measured, name) < getattr(ideal, name) * 1.26
    assert blurred_wreck.level_db(before) < ideal.peak_db - 6
    assert shadow.contrast_db(before, blurred_wreck.POINT_M[:2]) < ideal.contrast_db - 3
    pictures = {"navigate-track.png", "navigate-coherence.png", "before-and-after.png"}
    assert pictures <= {path.name for path in (tmp_path / "processed").iterdir()}
