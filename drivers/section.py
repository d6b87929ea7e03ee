"""What every section of a config is."""

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """Refuses keys that it does not know, and stays as it was read."""

    model_config = ConfigDict(frozen=True, extra="forbid")
