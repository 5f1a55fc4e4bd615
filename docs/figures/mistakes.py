"""What an image of three points looks like if the recording is read in a wrong way."""

import warnings
from dataclasses import replace

import numpy as np
from drawing import plt, save

import clsas

sonar = clsas.Sonar(clsas.Pulse(100e3, 30e3, 2e-3), [[0.0, 0, 0]], tx_length_m=0.05)
track = clsas.Track.straight((-2.5, 0, 0), (0.2, 0, 0), pings=251, ping_interval_s=0.1)
points = clsas.PointTargets([[0.3, 20.0, 0], [-0.8, 21.0, 0], [0.9, 21.8, 0]])
echoes = clsas.simulate(sonar, track, points, range_m=(18, 26), snr_db=20, seed=0)
lines = clsas.compress(echoes)
step_m, held = lines.range_step_m, lines.tx_m[np.arange(251) // 10 * 10]
rate_m = echoes.sound_speed_m_s / (2 * echoes.sample_rate_hz)
wrong = {
    "as it should be": lines,
    "phase of the opposite sign": replace(lines, samples=lines.samples.conj()),
    "range step c/fs": replace(lines, range_step_m=2 * step_m),
    "uncompressed": replace(
        lines, samples=echoes.samples, range_step_m=rate_m,
        first_range_m=echoes.start_time_s * echoes.sound_speed_m_s / 2,
    ),
    "real part only": replace(lines, samples=lines.samples.real.astype(complex)),
    "fixes held over ten pings": replace(lines, tx_m=held, rx_m=held),
}  # fmt: skip

grid = clsas.Grid.plane((-2, 2, 201), (19, 23.5, 226))
figure, panels = plt.subplots(2, 3, figsize=(7.6, 5.8), sharex=True, sharey=True)
for axes, (name, each) in zip(panels.flat, wrong.items(), strict=True):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", clsas.ClsasWarning)
        image = clsas.backproject(each, grid)
    drawn = axes.imshow(
        image.db(reference=lines.channels), cmap="inferno", vmin=-30, vmax=0, origin="lower",
        extent=(-2, 2, 19, 23.5),
    )  # fmt: skip
    axes.set_title(name, fontsize=10)
figure.supxlabel("Along-track (m)", fontsize=10)
figure.supylabel("Across-track (m)", fontsize=10)
figure.colorbar(drawn, ax=panels, label="Amplitude (dB re perfect sum)", shrink=0.7)
save(figure, "mistakes.png")
