"""Fixtures that tests of several commands share."""

import pytest

from clsas import plot


@pytest.fixture
def figures(monkeypatch):
    """Figures that a command saves."""
    saved = []
    save = plot.save

    def recorded(figure, path, **options):
        saved.append(figure)
        save(figure, path, **options)

    monkeypatch.setattr(plot, "save", recorded)
    return saved
