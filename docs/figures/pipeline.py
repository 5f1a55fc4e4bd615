"""The pipeline: from pings to an image, with the function of each step."""

from drawing import BLUE, INK, ORANGE, RED, TEAL, arrow, box, canvas, save

SIZE = (1.85, 0.86)
COLUMNS, ROWS = (0.1, 2.85, 5.6, 8.6), (3.75, 2.05, 0.35)


def at(column, row):
    return COLUMNS[column], ROWS[row]


figure, axes = canvas(10.6, 4.75)
box(axes, at(0, 1), SIZE, "Sonar, Track", "and a scene: points,\na seabed", colour=TEAL)
box(axes, at(1, 1), SIZE, "Echoes", "of each channel,\nbefore compression", colour=INK)
box(axes, at(2, 1), SIZE, "RangeLines", "compressed, with tx and\nrx of each line", colour=INK)
box(axes, at(3, 1), SIZE, "Image", "complex pixels\non the grid", colour=INK)
box(axes, at(2, 0), SIZE, "Grid", "plane, height map\nor points", colour=INK)
box(axes, at(3, 0), SIZE, "Plan", "tree, filters; predicted\nerror, time, memory", colour=RED)
box(axes, at(1, 2), SIZE, "recording", "of any format: samples\nand positions", colour=TEAL)
box(axes, at(2, 2), SIZE, "Store", "an image of any size,\npatch by patch", colour=ORANGE)
box(axes, at(3, 2), SIZE, "results", "figures of merit,\npictures, files", colour=BLUE)

middle = ROWS[1] + SIZE[1] / 2
for column, label in ((0, "simulate"), (1, "compress"), (2, "backproject")):
    start = COLUMNS[column] + SIZE[0]
    arrow(axes, (start + 0.03, middle), (COLUMNS[column + 1] - 0.03, middle), label)
axes.text(8.02, middle - 0.09, "wavenumber", ha="center", va="top", size=8.5, family="monospace")
arrow(axes, (7.48, 4.18), (8.57, 4.18), "plan")
arrow(axes, (6.52, 3.73), (6.52, 2.93), style="-")
arrow(axes, (9.52, 3.73), (9.52, 2.93), "factorize", offset=(-0.45, -0.08))
arrow(axes, (9.52, 2.03), (9.52, 1.23), "measure_point, save, plot", offset=(-1.05, -0.08))
arrow(axes, (6.52, 2.03), (6.52, 1.23), "mosaic", offset=(0.35, -0.08))
arrow(axes, (7.48, 0.78), (8.57, 0.78))
arrow(axes, (3.77, 1.23), (3.77, 2.03), "Echoes(...)", offset=(-0.52, -0.08))
arrow(axes, (4.4, 1.23), (5.75, 2.03), "RangeLines(...)", offset=(0.6, -0.3))
save(figure, "pipeline.svg")
