"""What a program gives as a config or a mounting, and the kernels that a config needs."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from service.api.recordings import AnyPath
from service.compile.cache import ensure_cache_dir
from service.compile.warm_up import KernelProgress, warm_up_in_turn
from service.config import ReplayConfig, load_replay_config, parse_replay_config
from service.encoding import warm_up as warm_up_encoding
from service.errors import UsageError
from service.geometry.se2 import SE2

log = logging.getLogger("corridor")  # not below "service", whose warnings a replay takes into its summary


def config_of(config: AnyPath | Mapping[str, Any]) -> ReplayConfig:
    """Of a YAML file, or of what would stand in one. Raises ConfigError with every fault."""
    if isinstance(config, Mapping):
        return parse_replay_config(yaml.safe_dump(dict(config), sort_keys=False), "config")
    return load_replay_config(Path(config))


def mountings_of(mountings: Mapping[str, npt.ArrayLike]) -> dict[str, SE2]:
    """pose_base_sensor of (x m, y m, yaw rad). Raises UsageError."""
    poses = {}
    for name, mounting in mountings.items():
        place = np.asarray(mounting, np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise UsageError(f"mounting of {name}: {place.tolist()}; expected (x m, y m, yaw rad)")
        poses[name] = SE2(*place.tolist())
    return poses


def stored_folder(map: AnyPath | None, version: int | None) -> Path | None:
    """Of the stored map to begin in. Raises UsageError for a version of no map."""
    if map is None and version is not None:
        raise UsageError(f"version {version} is of a stored map; name its folder by map")
    return None if map is None else Path(map)


def load_kernels() -> None:
    """Load the kernels of the profiles chosen so far; where they are compiled first, the log reports it."""
    ensure_cache_dir()
    warm_up_encoding()
    warm_up_in_turn(KernelProgress(CompileNotice()))


class CompileNotice:
    """Called whenever something of the kernels is compiled; logs it once, for that takes a minute."""

    def __init__(self) -> None:
        self._is_logged = False

    def __call__(self, progress: KernelProgress | None = None) -> None:
        if not self._is_logged:
            self._is_logged = True
            log.warning("compiling the kernels for this processor, once: half a minute to three minutes")
