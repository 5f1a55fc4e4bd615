import numpy as np

from clsas.signal.echoes import Echoes


def test_echoes_without_a_pulse_describe_themselves():
    echoes = Echoes(np.ones((2, 4), complex), 0, 1e5, 1e6, [0, 0, 0], [0, 0, 0], 1500)
    assert repr(echoes) == "Echoes(2 channels of 4 samples at 100 kHz, carrier 1 MHz)"
