"""The rooms of the house, and what flows between them. Imports point up, data flow down."""

from drawing import BLUE, INK, ORANGE, RED, TEAL, arrow, box, canvas, save

FLOORS = (
    ((("data", "what are the data?\nRangeLines, Grid, Image, Track, BeamWindow"),), INK),
    (
        (
            ("signal", "how are lines sampled?\nechoes, spectrum, filters"),
            ("water", "how does sound travel?\nrays, homogeneous water"),
            ("device", "how does a device see it?\ndevices, buffers, kernels"),
        ),
        TEAL,
    ),
    ((("exact", "the image, whatever it takes\ntiles, backprojection"),), RED),
    ((("factorized", "the image, fast\ntrack, plan, tree, stages, leaves"),), RED),
    (
        (
            ("simulation", "what would be received?\nscenes, simulator"),
            ("navigation", "where was the sonar?\ntracks, autofocus"),
            ("inspection", "is the recording sound?\nlevels, phase sign"),
            ("measures", "how good is the image?\nquality, effects"),
            ("interferometry", "how high is it?\nheights"),
        ),
        BLUE,
    ),
    (
        (
            ("files", "in and out\nHDF5, scene files"),
            ("mosaics", "larger than memory\nsurvey, patches, store"),
            ("plot", "what does it show?\nimages, tracks, trade-offs"),
            ("maps", "where on Earth?\nGeoTIFF, netCDF"),
        ),
        INK,
    ),
    (
        (
            ("processing", "from a recording to an image\nsteps, records"),
            ("selftest", "is it right, is it fast?\noracle, benchmarks, demo"),
            ("cli", "the command line\none file per group of commands"),
        ),
        ORANGE,
    ),
)
FLOWS = (
    "samples, positions, pixels",
    "spectra, rays, buffers",
    "exact images",
    "plans, images",
    "corrected lines, findings, figures",
    "stored images, pictures",
)
WIDTH, HEIGHT, STEP = 11.0, 0.92, 1.4

figure, axes = canvas(WIDTH, STEP * len(FLOORS) + 0.05)
for floor, (rooms, colour) in enumerate(FLOORS):
    y = STEP * (len(FLOORS) - floor) - HEIGHT - 0.05
    width = (WIDTH - 0.2) / len(rooms)
    for number, (name, text) in enumerate(rooms):
        corner = (0.1 + number * width + 0.06, y)
        box(axes, corner, (width - 0.12, HEIGHT), name, text, colour=colour)
    if floor < len(FLOWS):
        arrow(axes, (WIDTH / 2, y - 0.03), (WIDTH / 2, y - STEP + HEIGHT + 0.03))
        axes.text(WIDTH / 2 + 0.15, y - (STEP - HEIGHT) / 2, FLOWS[floor], va="center", size=9)
save(figure, "house.svg")
