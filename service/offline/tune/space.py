"""Which settings of a profile are searched, and between which values."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel

from service.errors import UsageError
from service.mapper.profiles import MappingConfig
from service.suggestion import suggest

FACTOR = 10.0  # to each side of the present value, where no range is given
USUAL_SLOTS = ("motion_model", "matcher")  # whose settings are searched where none is named
DIGITS = 3  # of a value
NEEDS = {"odometry_": "odom", "gyro_": "imu"}  # beginning of a setting -> the samples that it is about


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of the settings, searched on a logarithmic scale.

    path     from the mapping section on: ("settings", "matcher", "wall_sigma_m")
    low, high   what is tried
    """

    path: tuple[str, ...]
    present: float
    low: float
    high: float
    is_whole: bool

    @property
    def name(self) -> str:
        return ".".join(self.path[1:])

    def suggested(self, trial: Any) -> float:
        """Values of an Optuna trial."""
        suggest_number = trial.suggest_int if self.is_whole else trial.suggest_float
        return self.tried(suggest_number(self.name, self.low, self.high, log=True))

    def tried(self, value: float) -> float:
        """To so many digits as the patch has: what is measured is what it states."""
        return round(value) if self.is_whole else float(f"{value:.{DIGITS}g}")


def parameters_of(
    mapping: MappingConfig, wanted: Sequence[str], samples: Collection[str] = tuple(NEEDS.values())
) -> list[Parameter]:
    """`wanted` has names, each with `=LOW:HIGH` where not a tenth to ten times the present value is tried;
    `matcher.wall_sigma_m`, or the end of it where that fits one alone. Without any, the fractions among the
    settings of USUAL_SLOTS. What only samples decide that no session has is not searched, and refused where
    it is named: any value of it would do.

    samples   kinds in the sessions, as of NEEDS

    Raises UsageError.
    """
    numbers = {parameter.name: parameter for parameter in _numbers(mapping.settings, ("settings",))}
    if not wanted:
        usual = [one for one in numbers.values() if one.name.partition(".")[0] in USUAL_SLOTS]
        return [one for one in usual if not one.is_whole and not _missing(one, samples)]
    found: dict[str, Parameter] = {}
    for words in wanted:
        name, _, span = words.partition("=")
        fitting = [one for one in numbers if one == name or one.endswith(f".{name}")]
        if len(fitting) != 1:
            ends = sorted({one.rpartition(".")[2] for one in numbers})
            hint = " or ".join(fitting) or suggest(name.rpartition(".")[2], ends)
            raise UsageError(f"--parameter {name}: {'which one? ' if fitting else 'unknown; '}{hint}")
        parameter = numbers[fitting[0]]
        if kind := _missing(parameter, samples):
            raise UsageError(f"--parameter {name}: no session has samples of {kind}; leave it out")
        found[parameter.name] = _between(parameter, span) if span else parameter
    return list(found.values())


def _missing(parameter: Parameter, samples: Collection[str]) -> str:
    """Kind of the samples that it is about, where there are none; else ""."""
    needed = (kind for begin, kind in NEEDS.items() if parameter.path[-1].startswith(begin))
    return next((kind for kind in needed if kind not in samples), "")


def _between(parameter: Parameter, span: str) -> Parameter:
    try:
        low, high = (float(word) for word in span.split(":"))
    except ValueError:
        low = high = math.nan
    if not 0.0 < low < high < math.inf:
        raise UsageError(
            f"--parameter {parameter.name}={span}: expected LOW:HIGH, both above 0, as 0.001:0.1"
        )
    return replace(parameter, low=low, high=high)


def _numbers(settings: BaseModel | None, path: tuple[str, ...]) -> Iterator[Parameter]:
    """Numbers above 0: others, such as 0 for `off`, cannot be scaled by a factor."""
    for name, field in type(settings).model_fields.items() if settings is not None else ():
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            yield from _numbers(value, (*path, name))
        elif isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
            low, high = value / FACTOR, value * FACTOR
            is_whole = isinstance(value, int)
            for bound in field.metadata:
                low = max(low, getattr(bound, "ge", low), getattr(bound, "gt", low))
                high = min(high, getattr(bound, "le", high), getattr(bound, "lt", high))
            if is_whole:
                low, high = max(round(low), 1), round(high)
            if low < high:
                yield Parameter((*path, name), value, low, high, is_whole)


def section_of(parameters: Sequence[Parameter], values: Mapping[str, float]) -> dict[str, Any]:
    """The part of a mapping section that has these values."""
    section: dict[str, Any] = {}
    for parameter in parameters:
        below = section
        for key in parameter.path[:-1]:
            below = below.setdefault(key, {})
        below[parameter.path[-1]] = values[parameter.name]
    return section
