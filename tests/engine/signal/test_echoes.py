import numpy as np
import pytest

from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes


def test_echoes_without_a_pulse_describe_themselves():
    echoes = Echoes(np.ones((2, 4), complex), 0, 1e5, 1e6, [0, 0, 0], [0, 0, 0], 1500)
    assert repr(echoes) == "Echoes(2 channels of 4 samples at 100 kHz, carrier 1 MHz)"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tx_m": np.zeros((3, 3))}, "tx_m must have shape"),
        ({"start_time_s": [0.0, np.nan]}, "start_time_s must be finite"),
        ({"sound_speed_m_s": 0}, "sound_speed_m_s must be finite and > 0"),
        ({"rx_velocity_m_s": [0, 2000, 0]}, "the speed of rx_velocity_m_s must be .*< 1500 m/s"),
    ],
)
def test_channels_are_checked_as_those_of_lines_are(changes, message):
    shared = {"carrier_hz": 1e6, "tx_m": [0, 0, 0], "rx_m": [0, 0, 0], "sound_speed_m_s": 1500}
    samples = np.ones((2, 4), complex)
    echoes = {"samples": samples, "start_time_s": 0, "sample_rate_hz": 1e5} | shared | changes
    with pytest.raises(ValueError, match=message):
        Echoes(**echoes)
    lines = {"samples": samples, "first_range_m": 0, "range_step_m": 0.01} | shared | changes
    lines["first_range_m"] = lines.pop("start_time_s", 0)
    with pytest.raises(ValueError, match=message.replace("start_time_s", "first_range_m")):
        RangeLines(**lines)
