"""Refraction: a profile, rays through it, and the apparent antenna of one of them."""

import numpy as np
from drawing import BLUE, INK, ORANGE, RED, TEAL, plt, save

import clsas
from clsas.engine.water.rays import rays

PROFILE = clsas.SoundSpeed([0, 11, 14, 26], [1510, 1510, 1495, 1494])
SONAR, SEABED = 6.0, 22.0


def path(distance_m):
    """Horizontal distances and depths along the ray to a point on the seabed."""
    found = rays(PROFILE, distance_m, -SONAR, -SEABED)
    depth = np.linspace(SONAR, SEABED, 2000)
    cosine = float(found.slowness_s_m) * np.interp(depth, PROFILE.depth_m, PROFILE.speed_m_s)
    slope = cosine / np.sqrt(1 - cosine**2)
    steps = (slope[1:] + slope[:-1]) / 2 * np.diff(depth)
    return np.concatenate([[0], np.cumsum(steps)]), depth, found


figure, (speed, along) = plt.subplots(
    1, 2, figsize=(9.2, 3.8), width_ratios=(1, 3.4), sharey=True, layout="constrained"
)
speed.plot(PROFILE.speed_m_s, PROFILE.depth_m, color=BLUE)
speed.set(xlabel="sound speed (m/s)", ylabel="depth (m)", xlim=(1490, 1515), ylim=(26, 0))
along.axhspan(SEABED, 26, color="#d8c9a8", lw=0)
for distance in (25, 50, 75, 100):
    x, depth, found = path(distance)
    along.plot(x, depth, color=TEAL, lw=1.4)
    along.plot([0, distance], [SONAR, SEABED], color=INK, lw=0.7, ls=":")
apparent = SEABED - distance * -float(found.other_slope_s_m / found.slowness_s_m)
along.plot([0, distance], [apparent, SEABED], color=ORANGE, lw=1.2, ls="--")
along.plot(0, SONAR, "s", color=RED, ms=7)
along.plot(0, apparent, "s", mfc="white", mec=ORANGE, ms=7)
along.text(1.5, SONAR - 0.8, "antenna", color=RED, size=9)
along.text(1.5, apparent - 0.8, "apparent antenna", color=ORANGE, size=9)
along.text(52, 8.6, "rays", color=TEAL, size=9)
along.text(1.5, 20.5, "dotted: straight", color=INK, size=9)
along.set(xlabel="horizontal distance (m)", xlim=(-3, 104))
save(figure, "refraction.svg")
