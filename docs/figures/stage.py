"""What stages make of an image and its lines: ever smaller subimages, ever fewer and shorter lines.

Sizes are those of a plan: 512 x 512 pixels, 640 lines of 1 MHz, -50 dB.
"""

from drawing import BLUE, INK, ORANGE, PALE, TEAL, arrow, canvas, save
from matplotlib.patches import Rectangle

STAGES = (  # subimages along y and x, channels and samples of each
    ("lines", 1, 1, 640, 720),
    ("stage 1", 1, 2, 321, 720),
    ("stage 2", 4, 2, 165, 368),
    ("stage 3", 4, 16, 50, 192),
    ("stage 4", 8, 64, 20, 96),
)
LEFT, STEP, SIDE = 0.75, 1.75, 1.25

figure, axes = canvas(9.4, 4.6)
for number, (name, rows, columns, channels, samples) in enumerate(STAGES):
    x = LEFT + number * STEP
    axes.text(x + SIDE / 2, 4.35, name, ha="center", weight="bold")
    height, width = 1.35 * channels / 640, SIDE * samples / 720
    axes.add_patch(
        Rectangle((x + (SIDE - width) / 2, 3.95 - height), width, height, fc=TEAL, alpha=0.35)
    )
    for line in range(max(channels // 40, 1)):
        y = 3.95 - height * (line + 0.5) / max(channels // 40, 1)
        axes.plot([x + (SIDE - width) / 2, x + (SIDE + width) / 2], [y, y], color=TEAL, lw=0.8)
    axes.text(
        x + SIDE / 2,
        2.48,
        f"{channels} lines\nof {samples} samples",
        ha="center",
        va="top",
        size=8.5,
    )
    axes.add_patch(Rectangle((x, 0.45), SIDE, SIDE, fc=PALE, ec=INK, lw=1.2))
    for row in range(1, rows):
        y = 0.45 + SIDE * row / rows
        axes.plot([x, x + SIDE], [y, y], color=BLUE, lw=0.7)
    for column in range(1, columns):
        x_line = x + SIDE * column / columns
        axes.plot(
            [x_line, x_line], [0.45, 0.45 + SIDE], color=BLUE, lw=0.7 if columns < 20 else 0.3
        )
    axes.add_patch(
        Rectangle((x, 0.45), SIDE / columns, SIDE / rows, fc=ORANGE, ec=ORANGE, alpha=0.8, lw=0.8)
    )
    count = rows * columns
    per = "the image" if number == 0 else f"for each of {count}"
    axes.text(x + SIDE / 2, 0.32, per, ha="center", va="top", size=8.5)
    if number:
        arrow(axes, (x - STEP + SIDE + 0.05, 3.3), (x - 0.05, 3.3), colour=INK)
arrow(axes, (LEFT + 4 * STEP + SIDE + 0.02, 3.3), (9.3, 3.3), colour=INK)
axes.text(9.37, 3.42, "pixels", ha="right", va="bottom", size=8.5)
axes.text(0.62, 3.3, "lines", rotation=90, ha="right", va="center", color=TEAL)
axes.text(0.62, 1.07, "subimages", rotation=90, ha="right", va="center", color=BLUE)
save(figure, "stage.svg")
