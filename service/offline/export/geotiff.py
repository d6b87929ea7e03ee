"""A map as GeoTIFF. Source: OGC GeoTIFF standard 1.1 (OGC 19-008r4): its tags and its GeoKeys."""

from pathlib import Path

import numpy as np

from service.extras import optional
from service.geometry.geo_reference import GeoReference
from service.mapstore.picture import GREY_UNKNOWN, Picture
from service.offline.export.geo_export import placed

MODEL_TRANSFORMATION, GEO_KEYS, GEO_ASCII, GDAL_NODATA = 34264, 34735, 34737, 42113
MODEL_TYPE, RASTER_TYPE, CITATION, PROJECTED_CRS, LINEAR_UNITS = 1024, 1025, 1026, 3072, 3076
PROJECTED, USER_DEFINED, PIXEL_IS_AREA, METRE = 1, 32767, 1, 9001
UTM_NORTH, UTM_SOUTH = 32600, 32700  # EPSG, plus the zone
SHORT, ASCII, DOUBLE = 3, 2, 12


def write_geotiff(path: Path, picture: Picture, reference: GeoReference | None) -> None:
    """The pixels of the PGM, grey, unknown as nodata.

    reference   UTM on WGS 84, the zone of the map's origin; None: metres of the map, in no known place

    Raises OSError, InputError where UTM ends, CorridorError where tifffile is not installed.
    """
    tifffile = optional("tifffile", "export", "--format geotiff")
    utm, (a, d, b, e, x, y) = placed(path, picture, reference)
    citation, crs = "Frame of the map: metres, place on the earth unknown|", []
    if utm is not None:
        zone, is_south = utm
        citation = f"WGS 84 / UTM zone {zone}{'S' if is_south else 'N'}|"
        crs = [(PROJECTED_CRS, 0, 1, (UTM_SOUTH if is_south else UTM_NORTH) + zone)]
    keys = [
        (MODEL_TYPE, 0, 1, USER_DEFINED if utm is None else PROJECTED),
        (RASTER_TYPE, 0, 1, PIXEL_IS_AREA),
        (CITATION, GEO_ASCII, len(citation), 0),
        *crs,
        (LINEAR_UNITS, 0, 1, METRE),
    ]
    directory = [1, 1, 1, len(keys), *(value for key in keys for value in key)]
    matrix = [a, b, 0.0, x, d, e, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    tifffile.imwrite(
        path,
        np.vstack(list(picture.bands())),
        photometric="minisblack",
        compression="zlib",
        software="corridor",
        metadata=None,
        extratags=[
            (MODEL_TRANSFORMATION, DOUBLE, 16, matrix, True),
            (GEO_KEYS, SHORT, len(directory), directory, True),
            (GEO_ASCII, ASCII, len(citation) + 1, citation, True),
            (GDAL_NODATA, ASCII, 4, str(GREY_UNKNOWN), True),
        ],
    )
