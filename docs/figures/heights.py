"""Heights: two banks look at a point; height of ambiguity by range; deviation by coherence."""

import numpy as np
from drawing import BLUE, INK, ORANGE, RED, TEAL, arrow, plt, save

figure, (geometry, ambiguity, deviation) = plt.subplots(
    1, 3, figsize=(11.5, 3.9), width_ratios=(1.25, 1, 1)
)
y = np.linspace(-0.5, 7.2, 200)
seabed = -3.2 + 0.12 * np.sin(1.6 * y) + 0.9 * np.exp(-((y - 5.4) ** 2) / 0.5)
geometry.fill_between(y, seabed, -4.2, color="#d8c9a8")
lower, upper, point = np.array([0, -0.35]), np.array([0, 0.35]), np.array([5.4, -2.3])
for bank, colour in ((lower, BLUE), (upper, TEAL)):
    geometry.plot(*zip(bank, point, strict=True), color=colour, lw=1.2)
    geometry.plot(*bank, "s", color=colour, ms=8)
geometry.plot(0, 0, "^", color=RED, ms=7)
geometry.plot(*point, "*", color=INK, ms=11)
geometry.text(0.3, 0.45, "bank b", color=TEAL, size=9)
geometry.text(0.35, -0.75, "bank a", color=BLUE, size=9, rotation=-18)
geometry.text(0.25, -0.12, "tx", color=RED, size=9)
arrow(geometry, (-0.45, -0.45), (-0.45, 0.45), style="<|-|>")
geometry.text(-0.65, -0.1, "baseline B", size=9, ha="right")
geometry.text(3.1, -0.75, "r", color=TEAL, size=11)
geometry.plot([5.4, 6.9], [-3.2, -3.2], color=INK, lw=0.7, ls=":")
arrow(geometry, (6.7, -3.2), (6.7, -2.3), style="<|-|>")
geometry.plot([5.4, 6.9], [-2.3, -2.3], color=INK, lw=0.7, ls=":")
geometry.text(6.85, -2.75, "h", size=11, va="center")
geometry.set(xlim=(-2.6, 7.4), ylim=(-4.2, 1.4), aspect="equal", title="Looking along the track")
geometry.set(xlabel="y: across the track", ylabel="z: up", xticks=[], yticks=[])

WAVELENGTH_M, NEAREST_M = 0.015, 5.0
range_m = np.linspace(NEAREST_M, 200, 400)
for baseline_m, colour in ((0.1, ORANGE), (0.3, TEAL), (1.0, BLUE)):
    ambiguity.plot(
        range_m, WAVELENGTH_M * range_m / baseline_m, color=colour, label=f"B = {baseline_m:g} m"
    )
ambiguity.set(xlim=(0, 200), ylim=(0, 12), xlabel="Range (m)", ylabel="Height of ambiguity (m)")
ambiguity.set_title("Vertical baseline, 100 kHz")
ambiguity.legend(frameon=False, fontsize=9)

coherence = np.linspace(0.3, 0.999, 400)
for looks, colour in ((9, ORANGE), (25, TEAL), (100, BLUE)):
    cycles = np.sqrt((1 - coherence**2) / (2 * looks * coherence**2)) / (2 * np.pi)
    deviation.semilogy(coherence, 100 * cycles, color=colour, label=f"{looks} looks")
deviation.set(xlim=(0.3, 1), ylim=(0.05, 20), xlabel="Coherence")
deviation.set(ylabel="Deviation (% of the ambiguity)", title="Deviation of a height")
deviation.legend(frameon=False, fontsize=9)
deviation.grid(alpha=0.3, which="both")
save(figure, "height-geometry.svg")
