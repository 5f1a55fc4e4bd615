"""Images on maps: GeoTIFF, netCDF, and pictures with world files, for other programs.

The functions below implement methods of `Georeference` and `Track`.
"""

from clsas.maps.georeferencing import affine as affine
from clsas.maps.georeferencing import convergence_deg as convergence_deg
from clsas.maps.georeferencing import from_geographic as from_geographic
from clsas.maps.georeferencing import geographic_poses as geographic_poses
from clsas.maps.georeferencing import map_crs as map_crs
from clsas.maps.georeferencing import name_of_crs as name_of_crs
from clsas.maps.georeferencing import north_up as north_up
from clsas.maps.georeferencing import to_geographic as to_geographic
