"""The study of certificates counts what they say of an image as it is."""

import numpy as np
import pytest
from studies import certificates
from studies.certificates import FIXED, LONG, SHORT, Judged


def image(excess_db, error, deviation):
    """Return an image whose certificates all state the same, relative to the true error."""
    one = np.array([error, deviation**2, 0.0], np.float32)
    long, short = (np.tile(one, (4, len(rounds), 1)) for rounds in (LONG, SHORT))
    return Judged(0, "exact", -40.0, -40.0 + excess_db, -40.0, 10**4, long, short)


@pytest.mark.watches("scripts/studies", "scripts/bench")
def test_certificates_are_counted():
    found = certificates.statistics([image(2, 1.2, 0.01), image(-1, 0.8, 0.2)], 4)
    for count in FIXED:
        column = f"{count} pixels"
        assert found.of(certificates.within(1, ""), column) == 1
        assert found.of(certificates.UPPER, column) == 1
        assert found.of(certificates.LOWER, column) == 0.5
        assert found.of(certificates.of_own(1), column) == 1
        assert found.of(certificates.of_own(None), column) == 0
        assert found.of(certificates.called_missed(3.0), column) == 0.5
    assert len(found.table()) == len(certificates.ROWS)


def test_the_rule_ends_once_an_image_is_decided():
    (decided,) = list(certificates.certificates(image(0, 1.2, 0.01), LONG, 1))
    assert certificates.after_rule(decided, 0.0, 0.0).pixels == 64
    assert certificates.after_rule(decided, np.inf, 0.0).pixels == 256
    (undecided,) = list(certificates.certificates(image(0, 1.2, 0.5), LONG, 1))
    assert certificates.after_rule(undecided, np.inf, 0.0).pixels == 1024
