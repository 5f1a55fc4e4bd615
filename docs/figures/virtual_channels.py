"""A steering function over the aperture: as it is, aligned, and interpolated from virtual channels.

The scene is that of the thesis: 640 channels over 5.28 m, 1 MHz, a subimage of 0.16 m at 42.5 m.
"""

import functools

import numpy as np
from drawing import BLUE, INK, ORANGE, RED, TEAL, plt, save

WAVELENGTH_M, CHANNELS, LENGTH_M = 1.5e-3, 640, 5.28
CENTRE_M, SIDE_M = np.array([0.0, 42.5]), 0.16
x_m = (np.arange(CHANNELS) + 0.5) / CHANNELS * LENGTH_M - LENGTH_M / 2
track_m = np.stack([x_m, 0 * x_m], axis=1)


def ranges(point_m):
    return np.linalg.norm(track_m - point_m, axis=1)


def steering(point_m):
    """Return the steering function of a point, aligned on the subimage's centre."""
    return np.exp(4j * np.pi / WAVELENGTH_M * (ranges(point_m) - ranges(CENTRE_M)))


def place(oversampling):
    """Return where virtual channels lie, in their own spacings, for every channel.

    They are even in the direction cosine, in which a subimage limits the band.
    """
    cosine = x_m / np.hypot(x_m, CENTRE_M[1])
    spacing = WAVELENGTH_M / (2 * SIDE_M * oversampling)
    return (cosine - cosine[0]) / spacing


@functools.cache
def weights(taps, oversampling):
    """Return the weights [channel, virtual channel] of windowed sincs; of the nearest for one."""
    at = place(oversampling)
    nodes = np.arange(-taps, int(at[-1]) + taps + 1)
    away = at[:, None] - nodes
    if taps == 1:
        return nodes, (np.abs(away) <= 0.5).astype(float)
    beta = np.pi * taps / 2 * (1 - 1 / oversampling)
    window = np.i0(beta * np.sqrt(np.maximum(1 - (2 * away / taps) ** 2, 0))) / np.i0(beta)
    return nodes, np.where(np.abs(away) < taps / 2, np.sinc(away) * window, 0)


def interpolated(point_m, taps, oversampling):
    nodes, kernel = weights(taps, oversampling)
    # Virtual channels are channels themselves: their steering functions are known anywhere.
    cosine = x_m[0] / np.hypot(x_m[0], CENTRE_M[1]) + nodes * WAVELENGTH_M / (
        2 * SIDE_M * oversampling
    )
    node_m = np.stack([CENTRE_M[1] * cosine / np.sqrt(1 - cosine**2), 0 * cosine], axis=1)
    range_m = np.linalg.norm(node_m - point_m, axis=1) - np.linalg.norm(node_m - CENTRE_M, axis=1)
    values = np.exp(4j * np.pi / WAVELENGTH_M * range_m)
    return node_m[:, 0], values, kernel @ values


figure, (whole, aligned, errors) = plt.subplots(
    3, 1, figsize=(7.5, 8.2), height_ratios=(1, 1.35, 1.6)
)
corner_m = CENTRE_M + [0.45 * SIDE_M, 0.4 * SIDE_M]
near = np.abs(x_m) < 0.6
whole.plot(
    x_m[near], np.exp(4j * np.pi / WAVELENGTH_M * ranges(corner_m)).real[near], lw=0.8, color=BLUE
)
whole.set(
    title="Phase factor of a pixel before alignment, exp(j 2 k ρ)",
    ylabel="real part",
    xlim=(-0.6, 0.6),
)

exact = steering(corner_m)
nodes_m, values, smooth = interpolated(corner_m, 6, 1.5)
_, _, stairs = interpolated(corner_m, 1, 1.5)
aligned.plot(x_m, exact.real, lw=4, color=BLUE, alpha=0.35, label="every channel")
aligned.plot(
    x_m, smooth.real, lw=1.2, color=INK, label="interpolated from virtual channels, 6 taps"
)
aligned.plot(x_m, stairs.real, lw=0.8, color=RED, label="the nearest virtual channel")
aligned.plot(nodes_m, values.real, "o", ms=5, color=ORANGE, label="virtual channels")
aligned.set(
    title="Steering function: after alignment on the subimage's centre it varies slowly",
    ylabel="real part",
    xlim=(-0.6, 0.6),
)
aligned.set(xlabel="along the track (m)", ylim=(-1.2, 2.3))
aligned.legend(loc="upper center", ncols=2, fontsize="small", frameon=False)

random = np.random.default_rng(0)
pixels_m = CENTRE_M + random.uniform(-SIDE_M / 2, SIDE_M / 2, (15, 2))
for taps, colour, name in (
    (1, RED, "nearest (the thesis)"),
    (4, ORANGE, "4 taps"),
    (6, TEAL, "6 taps"),
    (8, BLUE, "8 taps"),
):
    counts, levels = [], []
    for oversampling in (
        (1.2, 1.4, 1.7, 2, 2.5, 3, 4, 6, 8) if taps == 1 else (1.2, 1.4, 1.7, 2, 2.5, 3)
    ):
        differ = [interpolated(p, taps, oversampling)[2] - steering(p) for p in pixels_m]
        levels.append(10 * np.log10(np.mean(np.abs(differ) ** 2)))
        counts.append(place(oversampling)[-1] + 1)
    errors.plot(counts, levels, "o-", color=colour, label=name)
errors.set(
    title=f"Error of the interpolation: subimage of {SIDE_M} m, {CHANNELS} channels",
    xlabel="virtual channels",
    ylabel="error (dB)",
    xlim=(0, 250),
    ylim=(-90, 0),
)
errors.grid(alpha=0.3)
errors.legend(frameon=False)
save(figure, "virtual-channels.svg")
