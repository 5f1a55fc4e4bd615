"""The tables of what runs on which device name tests that there are."""

from pathlib import Path

import pytest
from variants import EVERY_VARIANT, SOME_ELSEWHERE


@pytest.mark.parametrize("test", [*EVERY_VARIANT, *SOME_ELSEWHERE])
def test_every_test_in_the_tables_exists(test):
    file, name = test.split("::")
    (path,) = Path(__file__).parent.rglob(file)
    assert f"def {name}(" in path.read_text()
