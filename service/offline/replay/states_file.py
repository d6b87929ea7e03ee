"""states.csv of a replay: how good the pose of each scan was, as it would have been published live."""

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from service.errors import InputError
from service.geometry.poses import Floats
from service.offline.score.trajectory import parse_stamp, seconds_text
from service.outputs import STATES, MapperOutput
from service.readable import read_text

STATES_FILE = "states.csv"
COLUMNS = (
    "stamp_s",
    "state",
    "reason_id",
    "sigma_along_m",
    "sigma_across_m",
    "sigma_heading_deg",
    "inlier_ratio",
    "laser",
)


def sigmas_of(output: MapperOutput) -> tuple[float, float, float]:
    """Standard deviations of the pose in the map: m along the vehicle's x axis (forward), m across it (its
    y axis), deg; inf where it is not known.
    """
    variances = np.diag(output.covariance)
    known = np.where(np.isfinite(variances), np.maximum(variances, 0.0), math.inf)
    along, across, heading = np.sqrt(known).tolist()
    return along, across, math.degrees(heading)


def write_states(path: Path, outputs: Iterable[MapperOutput], lasers: Iterable[str]) -> None:
    """A row an output. lasers: whose scan each answers. Raises OSError."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for output, laser in zip(outputs, lasers, strict=True):
            along_m, across_m, heading_deg = sigmas_of(output)
            writer.writerow(
                (
                    seconds_text(output.stamp_ns),
                    output.state,
                    output.reason.id,
                    f"{along_m:.6f}",
                    f"{across_m:.6f}",
                    f"{heading_deg:.6f}",
                    f"{output.inlier_ratio:.4f}",
                    laser,
                )
            )


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """The N rows of a states.csv."""

    stamp_ns: npt.NDArray[np.int64]  # (N,)
    state: list[str]  # each one of STATES
    reason_id: list[str]
    sigma: Floats  # (N, 3) m along, m across, deg
    inlier_ratio: Floats  # (N,)
    laser: list[str]


def read_states(path: Path) -> States:
    """Raises InputError with file and line."""
    stamps, words, figures = [], [], []
    try:
        with StringIO(read_text(path), newline="") as file:
            reader = csv.DictReader(file, strict=True)
            if missing := set(COLUMNS) - set(reader.fieldnames or ()):
                raise InputError(f"{path}:1: no column {', '.join(sorted(missing))}")
            for row in reader:
                where = f"{path}:{reader.line_num}"
                if None in row.values():
                    raise InputError(f"{where}: fewer than {len(COLUMNS)} columns")
                if row["state"] not in STATES:
                    raise InputError(f"{where}: the state {row['state']!r} is none of {', '.join(STATES)}")
                stamps.append(parse_stamp(row["stamp_s"], where))
                words.append((row["state"], row["reason_id"], row["laser"]))
                try:
                    figures.append([float(row[name]) for name in COLUMNS[3:7]])
                except ValueError as error:
                    raise InputError(f"{where}: {error}") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}") from error
    state, reason_id, laser = ([row[k] for row in words] for k in range(3))
    numbers = np.array(figures, np.float64).reshape(-1, 4)
    return States(np.array(stamps, np.int64), state, reason_id, numbers[:, :3], numbers[:, 3], laser)
