"""Base of the sections of a config."""

from collections.abc import Mapping
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """Frozen; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class HasDefaults(Protocol):
    """A model of a device that has defaults of its own for some settings."""

    @property
    def defaults(self) -> Mapping[str, Any]: ...


def with_defaults_of_model(given: Any, models: Mapping[str, HasDefaults]) -> Any:
    """Settings as given, and those left out as the given `model` has them."""
    name = given.get("model") if isinstance(given, dict) else None
    return {**models[name].defaults, **given} if isinstance(name, str) and name in models else given
