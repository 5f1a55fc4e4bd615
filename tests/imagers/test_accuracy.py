"""Every imager compared with an independent oracle, at the extremes."""

import pytest
from exactly import execute, prepare
from scenes import kept
from tiers import thinned

from clsas import wavenumber as form_wavenumber
from clsas.engine.data.beam import BeamWindow
from clsas.engine.factorized.costs import Costs
from clsas.engine.imaging import factorize, plan
from clsas.mosaics.mosaic import mosaic
from clsas.selftest import extremes
from clsas.selftest.extremes import (
    along_x,
    apart,
    array,
    at_1_khz,
    closed,
    edge,
    headings,
    loud,
    narrow,
    radar,
    rings,
    steps,
    ultrasonic,
    uneven,
    widest,
)
from clsas.selftest.oracle import Band


def line_in_the_spectrum(centre, width):
    """Return a weak flat band and, near its edge, a tone that is 20 dB stronger."""
    return [
        Band(centre, 0.9 * width, 0.01 * width, 0.1),
        Band(centre + 0.42 * width, 0.0, 0.01 * width, 1.0),
    ]


SLOW = Costs(pixel_ns=1e6, point_ns=1e6)  # plans for small images divide them
FAR = (1e7, -1e7, 1e7)
HANN = BeamWindow(12, "hann", along=[1, 0, 0])


def raw(channels=96, **options):
    """Return lines on their carrier. The echoes take most of the time, so there are only 20."""
    return extremes.raw(channels, targets=20, **options)


CASES = {
    "flat spectrum": lambda: ultrasonic(),
    "tilted by -20 dB": lambda: ultrasonic(tilt_db=-20),
    "bands at 0, -15 and -30 dB": lambda: ultrasonic(colour=steps),
    "a line 20 dB above the band": lambda: ultrasonic(colour=line_in_the_spectrum),
    **{
        f"oversampling {rate}, tilted by {tilt_db} dB": lambda rate=rate, tilt_db=tilt_db: (
            ultrasonic(oversampling=rate, tilt_db=tilt_db)
        )
        for rate, tilt_db in (
            (2.0, 10),
            (1.4, 0),
            (1.25, 10),
            (1.25, -20),
            (1.1, 0),
            (1.1, 10),
            (1.05, -20),
        )
    },
    "oversampling 1.25, bands at 0, -15 and -30 dB": lambda: ultrasonic(
        oversampling=1.25, colour=steps
    ),
    "oversampling 1.1, a line 20 dB above the band": lambda: ultrasonic(
        oversampling=1.1, colour=line_in_the_spectrum
    ),
    "noise -40 dB": lambda: ultrasonic(noise=0.01),
    "noise -10 dB": lambda: ultrasonic(noise=0.3),
    "noise +10 dB": lambda: ultrasonic(noise=3.0),
    "oversampling 1.25, tilted by 10 dB, noise -20 dB": lambda: ultrasonic(
        noise=0.1, oversampling=1.25, tilt_db=10
    ),
    "30 kHz on the carrier, 96 channels": lambda: raw(),
    "on carrier, 1 % offset": lambda: raw(offset=0.01),
    "on carrier, 5 % offset": lambda: raw(offset=0.05),
    "on carrier, 10 % offset, 300 channels": lambda: raw(300, oversampling=12.5, offset=0.1),
    "on carrier, offset larger than echoes": lambda: raw(offset=3.0),
    "on carrier, 5 % tail": lambda: raw(tail=0.05),
    "on carrier, noise": lambda: raw(noise=0.05),
    "10 000 km from the origin": lambda: ultrasonic(origin_m=FAR),
    "10 000 km from the origin, lines of different starts": lambda: ultrasonic(
        origin_m=FAR, own_starts=True
    ),
    "1 kHz, 1.5 km away": lambda: at_1_khz(),
    "10 GHz, 8 km away": lambda: radar(),
    "10 GHz, 10 000 km from the origin": lambda: radar(origin_m=FAR),
    "one channel": lambda: ultrasonic(channels=1),
    "two channels": lambda: ultrasonic(channels=2),
    "5000 channels": lambda: ultrasonic(channels=5000, shape=(24, 24), targets=2),
    "sway of 2 cm rms": lambda: ultrasonic(track=along_x(160, 8.25e-3, sway_m=0.02)),
    "closed track, 300 channels": lambda: closed(),
    "array, bistatic": lambda: array(moving=False),
    "array, moving receivers": lambda: array(moving=True),
    "band of 0.5 % of the carrier": lambda: narrow(),
    "band of 190 % of the carrier": lambda: widest(),
    "rings, on carrier": lambda: rings(),
    "band of 2 %, transmitter and receiver 10 m apart": lambda: apart(),
    "band of 0.5 %, transmitter and receiver 10 m apart": lambda: apart(bandwidth_hz=500),
    "band of 0.5 %, uneven velocities": lambda: uneven(),
    "headings under a Hann beam": lambda: headings(),
    "headings under a Hann beam, more pixels": lambda: headings(shape=(64, 64)),
    "a loud channel off the track": lambda: loud(),
    "edge of a Hann beam": lambda: edge(),
    "band of 2 % of the carrier": lambda: ultrasonic(bandwidth_hz=2e4, pixel_m=(4e-3, 2e-2)),
    "relief of 10 cm rms": lambda: ultrasonic(
        relief_m=0.1, track=along_x(160, 8.25e-3) + [0, 0, 20]
    ),
    "one point": lambda: ultrasonic(targets=1),
    "Hann beam, 600 channels": lambda: ultrasonic(track=along_x(600, 0.02), beam=HANN),
    "Hann beam, 600 channels, normalised, squint 3 degrees": lambda: ultrasonic(
        track=along_x(600, 0.02),
        beam=BeamWindow(12, "hann", squint_deg=3, along=[1, 0, 0], normalise=True),
    ),
}


AT_EVERY_TOLERANCE = (
    "flat spectrum", "oversampling 1.05, tilted by -20 dB", "30 kHz on the carrier, 96 channels",
    "sway of 2 cm rms", "array, moving receivers",
    "Hann beam, 600 channels, normalised, squint 3 degrees",
)  # fmt: skip
"""Cases that form images at every tolerance for every change; others do so at one of them."""


@kept
def made(name):
    return CASES[name]()


def promised(asked_db, predicted_db, records):
    """What an image may err by: what is asked, or what a warning says instead."""
    warned = any("error" in str(record.message) for record in records)
    return max(asked_db, predicted_db) if warned else asked_db


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "asked_db"), thinned(CASES, [-80, -50, -30], whole=AT_EVERY_TOLERANCE)
)
@pytest.mark.filterwarnings("always::clsas.engine.data.validate.ClsasWarning")
def test_exact(name, asked_db, platform, recwarn):
    known = made(name)
    prepared = prepare(
        known.lines, known.grid, device=platform, accuracy_db=asked_db, beam=known.beam
    )
    bound_db = promised(asked_db, prepared.error_db, recwarn)
    assert known.error_db(execute(prepared).pixels) <= bound_db


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "asked_db"), thinned(CASES, [-65, -50, -35], whole=AT_EVERY_TOLERANCE)
)
@pytest.mark.filterwarnings("always::clsas.engine.data.validate.ClsasWarning")
def test_factorized(name, asked_db, platform, recwarn):
    known = made(name)
    chosen = plan(
        known.lines, known.grid, tolerance_db=asked_db, beam=known.beam, device=platform,
        costs=SLOW,
    )  # fmt: skip
    image = factorize(known.lines, known.grid, chosen, device=platform)
    bound_db = promised(asked_db, chosen.predicted_error_db, recwarn)
    assert known.error_db(image.pixels) <= bound_db


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "tilted by -20 dB",
        "oversampling 1.25, tilted by 10 dB",
        "10 000 km from the origin",
        "Hann beam, 600 channels",
    ],
)
@pytest.mark.parametrize("how", [{"accuracy_db": -60}, {"tolerance_db": -50}])
def test_mosaic(name, how, platform):
    known = made(name)
    patches = mosaic(
        known.lines, known.grid, patches=(2, 3), device=platform, beam=known.beam, **how
    )
    assert known.error_db(patches.image().pixels) <= next(iter(how.values()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "oversampling"),
    thinned([{}, {"tilt_db": 10}, {"origin_m": FAR}, {"noise": 0.1}], [1.5, 1.25, 1.1]),
)
def test_wavenumber(options, oversampling):
    """A Hann window of 16 degrees has no edges that would be diffracted."""
    known = extremes.scene(
        along_x(240, 0.06), (0.3, 42.5, 0), carrier_hz=200e3, bandwidth_hz=20e3,
        pixel_m=(0.02, 0.03), shape=(24, 24), oversampling=oversampling,
        beam=BeamWindow(16, "hann", along=[1, 0, 0]), **options,
    )  # fmt: skip
    pixels = form_wavenumber(known.lines, known.grid, beam=known.beam).pixels
    assert known.error_db(pixels) <= -60
