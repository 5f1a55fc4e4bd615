"""Ghosts of phase centres that repeat from ping to ping, and the image without them."""

from dataclasses import replace

import numpy as np
from drawing import plt, save

import clsas
from clsas.selftest import wreck
from clsas.simulation import seabeds

scene = wreck.scene("wreck_two_banks")
sonar, track = scene.need("sonar", "track")
pings = slice(16, 54)
attitude = ("positions_m", "time_s", "velocity_m_s", "yaw_rad", "pitch_rad", "roll_rad")
track = replace(track, **{name: getattr(track, name)[pings] for name in attitude})
seabed = seabeds.wreck((-9, 3), (52, 68))
echoes = clsas.simulate(sonar.bank(0), track, seabed, snr_db=40, range_m=(54, 70))
lines = clsas.compress(echoes, **scene.compress)
grid = clsas.Grid.plane(x=(-7, 2, 226), y=(54.5, 65.5, 441))
beam = scene.image["beam"]
deck = slice(148, 230), slice(90, 150)  # x -3.4 to -1 m, y 58.2 to 60.2 m

figure, panels = plt.subplots(1, 2, figsize=(7.2, 4.6), sharey=True)
for axes, title, some in zip(
    panels,
    ("equal weights", "weights by density"),
    (lines, clsas.density_compensated(lines)),
    strict=True,
):
    image = clsas.factorize(some, grid, -50, beam=beam)
    reference = float(np.sqrt(np.mean(np.abs(image.pixels[deck]) ** 2)))
    drawn = axes.imshow(
        image.db(reference=reference), cmap="gray", vmin=-30, vmax=15, origin="lower",
        extent=(-7, 2, 54.5, 65.5),
    )  # fmt: skip
    axes.set(title=title, xlabel="Along-track (m)")
    axes.title.set_fontsize(10)
panels[0].set_ylabel("Across-track (m)")
figure.colorbar(drawn, ax=panels, label="Amplitude (dB re deck)", shrink=0.85)
save(figure, "density.png")
