"""changes.csv: the cells that differ from the stored map, for its maintainer."""

import csv
from io import StringIO
from pathlib import Path

import numpy as np

from service.errors import InputError
from service.mapper.map_changes import COARSER, MapChanges
from service.readable import read_text

CHANGES_FILE = "changes.csv"
COLUMNS = ("x_m", "y_m", "change", "first_stamp_ns", "last_stamp_ns", "scans")


def write_changes(path: Path, changes: MapChanges | None) -> None:
    """A line a cell: its middle in the map; "new" where something is now, "gone" where something was;
    the stamps of the first and of the last scan that saw it, and how many did. None: there is no file then,
    nor does one of before stay. Raises OSError.
    """
    path.unlink(missing_ok=True)
    if changes is None:
        return
    with path.open("w", encoding="ascii", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(COLUMNS)
        for (x_m, y_m), is_new, first_ns, last_ns, scans in zip(
            changes.xy_map.tolist(),
            changes.is_new.tolist(),
            changes.first_ns.tolist(),
            changes.last_ns.tolist(),
            changes.scans.tolist(),
            strict=True,
        ):
            lines.writerow(
                (f"{x_m:.2f}", f"{y_m:.2f}", "new" if is_new else "gone", first_ns, last_ns, scans)
            )


def read_changes(path: Path, cell_m: float) -> MapChanges | None:
    """Read the file of write_changes for a map with cells of cell_m; None where there is no such file.

    Raises InputError.
    """
    if not path.is_file():
        return None
    try:
        rows = list(csv.DictReader(StringIO(read_text(path, "ascii"), newline="")))
        return MapChanges(
            COARSER * cell_m,
            np.array([(float(row["x_m"]), float(row["y_m"])) for row in rows]).reshape(-1, 2),
            np.array([row["change"] == "new" for row in rows], np.bool_),
            np.array([int(row["first_stamp_ns"]) for row in rows], np.int64),
            np.array([int(row["last_stamp_ns"]) for row in rows], np.int64),
            np.array([int(row["scans"]) for row in rows], np.int64),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: no {CHANGES_FILE} of a replay: {error!r}; delete it to see the rest"
        ) from error
