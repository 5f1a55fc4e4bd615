"""Where an image errs: by the thesis's method and by interpolation, over subimages and pixels.

The mean of many scenes of random points, so that what remains is the method's own pattern.
"""

import numpy as np
from drawing import plt, save

import clsas

SCENES, PIXELS = 6, 256
x_m = 8.25e-3 * (np.arange(320) - 159.5)
track_m = np.stack([x_m, 0 * x_m, 0 * x_m], axis=1)
grid = clsas.Grid.plane(x=(-0.5, 0.5, PIXELS), y=(42, 43, PIXELS))
random = np.random.default_rng(0)
power, squares = 0.0, {}
ways = {
    "nearest beams, one stage of 8 × 4": {"stages": [(8, 4)]},
    "interpolated, tolerance −20 dB": {"tolerance_db": -20},
}
for _ in range(SCENES):
    places_m = random.uniform([-0.55, 41.9, 0], [0.55, 43.1, 0], (4000, 3))
    points = clsas.PointTargets(places_m, random.normal(size=(4000, 2)) @ [1, 1j])
    lines = clsas.simulate_lines(track_m, track_m, points, carrier_hz=1e6, bandwidth_hz=100e3)
    exact = clsas.backproject(lines, grid, accuracy_db=-70).pixels
    power = power + np.mean(np.abs(exact) ** 2) / SCENES
    for name, way in ways.items():
        image = clsas.factorize(lines, grid, clsas.plan(lines, grid, **way)).pixels
        squares[name] = squares.get(name, 0.0) + np.abs(image - exact) ** 2 / SCENES

figure, panels = plt.subplots(1, 2, figsize=(8.6, 4.2), sharey=True)
for axes, (name, square) in zip(panels, squares.items(), strict=True):
    blocks = square.reshape(PIXELS // 4, 4, PIXELS // 4, 4).mean(axis=(1, 3))
    level_db = 10 * np.log10(blocks / power)
    drawn = axes.imshow(
        level_db, cmap="inferno", vmin=-40, vmax=0, origin="lower", extent=(-0.5, 0.5, 42, 43)
    )
    mean_db = 10 * np.log10(square.mean() / power)
    axes.set(title=f"{name}: {mean_db:.0f} dB", xlabel="Along-track (m)")
    axes.title.set_fontsize(10)
panels[0].set_ylabel("Across-track (m)")
figure.colorbar(drawn, ax=panels, label="Error (dB re rms of the image)", shrink=0.85)
save(figure, "errors.png")
