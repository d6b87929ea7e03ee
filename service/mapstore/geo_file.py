"""geo.json: where a map lies on the earth, beside its map.yaml."""

import json
from pathlib import Path

from service.errors import InputError, words_of
from service.geometry.geo_reference import GeoReference
from service.readable import read_text

GEO_FILE = "geo.json"


def write_geo(path: Path, reference: GeoReference) -> None:
    """Raises OSError."""
    path.write_text(json.dumps(reference.as_dict(), indent=1) + "\n", encoding="ascii")


def read_geo(path: Path) -> GeoReference:
    """Raises InputError for what write_geo cannot have written."""
    try:
        return GeoReference.from_dict(json.loads(read_text(path)))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: {words_of(error)}") from error
