"""Speckle: one look, the mean power of four sub-bands, and that of a window."""

import numpy as np
from drawing import plt, save

import clsas

sonar = clsas.Sonar(
    pulse=clsas.Pulse(carrier_hz=100e3, bandwidth_hz=40e3, duration_s=1e-3),
    rx_m=[[0.075 * n, 0, 0] for n in range(-2, 2)],
    tx_length_m=0.15,
    rx_length_m=0.15,
)
track = clsas.Track.straight((-4, 0, 8), (1.5, 0, 0), pings=54, ping_interval_s=0.1)
x, y = np.meshgrid(np.linspace(-3, 3, 121), np.linspace(24, 33, 181))
rocks_m = np.zeros_like(x)
for at_x, at_y, radius_m in ((-1.0, 26.5, 0.5), (1.1, 27.5, 0.35), (0.2, 29.3, 0.25)):
    rocks_m += np.sqrt(np.maximum(radius_m**2 - (x - at_x) ** 2 - (y - at_y) ** 2, 0))
seabed = clsas.Seabed((-3, 3), (24, 33), rocks_m, 1 + 2 * (rocks_m > 0), density_m2=3000)
lines = clsas.compress(clsas.simulate(sonar, track, seabed, snr_db=50))
grid = clsas.Grid.plane(x=(-2, 2, 201), y=(25, 32, 351))
beam = clsas.BeamWindow(9.0, "hann")
one = clsas.factorize(lines, grid, -40, beam=beam)
window = clsas.multilook(one, window_m=0.15)
bands = [clsas.factorize(part, grid, -40, beam=beam) for part in clsas.sub_bands(lines, 4)]
looks = clsas.multilook(bands)

sand = slice(230, 330), slice(30, 170)
figure, panels = plt.subplots(1, 3, figsize=(7.6, 4.2), sharey=True)
for axes, name, image in zip(
    panels,
    ("the whole band", "four sub-bands", "window of 15 cm"),
    (one, looks, window),
    strict=True,
):
    contrast = clsas.contrast(image.pixels[sand])
    reference = float(np.sqrt(np.mean(np.abs(image.pixels[sand]) ** 2)))
    drawn = axes.imshow(
        image.db(reference=reference), cmap="gray", vmin=-25, vmax=10, origin="lower",
        extent=(-2, 2, 25, 32),
    )  # fmt: skip
    axes.set(title=f"{name}\ncontrast {contrast:.2f}", xlabel="Along-track (m)")
    axes.title.set_fontsize(10)
panels[0].set_ylabel("Across-track (m)")
figure.colorbar(drawn, ax=panels, label="Amplitude (dB re sand)", shrink=0.85)
save(figure, "speckle.png")
