"""Pictures of images, mosaics, volumes, heights, points, recordings, tracks, plans, trade-offs.

Most functions return a `matplotlib.figure.Figure` that belongs to no window and changes no global
state; `save` writes it as PNG, PDF or SVG. `image` draws into axes of your own, or into a new
pyplot figure.
"""

from clsas.plot.canvas import save as save
from clsas.plot.canvas import save_png as save_png
from clsas.plot.curves import cuts as cuts
from clsas.plot.curves import plan as plan
from clsas.plot.curves import tradeoff as tradeoff
from clsas.plot.images import before_and_after as before_and_after
from clsas.plot.images import image as image
from clsas.plot.images import image_db as image_db
from clsas.plot.images import image_html as image_html
from clsas.plot.images import mosaic as mosaic
from clsas.plot.images import patch_borders as patch_borders
from clsas.plot.interferometry import heights as heights
from clsas.plot.interferometry import interferogram as interferogram
from clsas.plot.navigation import coherence as coherence
from clsas.plot.navigation import corrections as corrections
from clsas.plot.navigation import sharpness as sharpness
from clsas.plot.recordings import echoes as echoes
from clsas.plot.recordings import geometry as geometry
from clsas.plot.recordings import inspection as inspection
from clsas.plot.recordings import range_lines as range_lines
from clsas.plot.volumes import points as points
from clsas.plot.volumes import volume as volume

__all__ = [
    "before_and_after",
    "coherence",
    "corrections",
    "cuts",
    "echoes",
    "geometry",
    "heights",
    "image",
    "image_db",
    "image_html",
    "inspection",
    "interferogram",
    "mosaic",
    "patch_borders",
    "plan",
    "points",
    "range_lines",
    "save",
    "save_png",
    "sharpness",
    "tradeoff",
    "volume",
]
