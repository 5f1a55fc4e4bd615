"""Pictures that replace those of an export."""

import numpy as np
import pytest

import clsas

pytest.importorskip("matplotlib")


@pytest.mark.slow
def test_a_picture_over_an_exported_one_is_not_taken_for_a_map(tmp_path):
    pytest.importorskip("pyproj")
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=30.0)
    grid = clsas.Grid.plane((0, 9, 10), (40, 49, 10), georeference=place)
    image = clsas.Image(np.ones((10, 10), complex), grid)
    clsas.export(image, tmp_path / "a.png")
    assert len(list(tmp_path.iterdir())) == 3
    (tmp_path / "b.pgw").touch()  # of another picture
    clsas.plot.save(clsas.plot.image_db(image), tmp_path / "a.png")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.png", "b.pgw"]
