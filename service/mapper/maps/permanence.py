"""Settings of how things that move are told from things that stay."""

from pydantic import BaseModel, ConfigDict, Field

from service.kernels.permanence import PermanenceSettings

TICK_S = 0.05  # in which it is counted how long something stands


def ticks_in(time_s: float) -> int:
    return round(time_s / TICK_S)


class PermanenceConfig(BaseModel):
    """When something counts in full, and when it is forgotten."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enough_s: float = Field(default=1.0, ge=0.0, le=6.0)  # 0: all things count alike, and stay
    free_s: float = Field(default=0.25, ge=0.0, le=6.0)
    passed_gain: float = Field(default=1.0, ge=0.0)
    least_weight: float = Field(default=0.1, gt=0.0, le=1.0)
    most_gain: float = Field(default=2.0, ge=1.0)
    behind_m: float = Field(default=0.2, gt=0.0)
    beam_step: int = Field(default=3, ge=1)

    def settings(self) -> PermanenceSettings:
        return PermanenceSettings(
            ticks_in(self.enough_s),
            ticks_in(self.free_s),
            self.passed_gain,
            self.least_weight,
            self.most_gain,
            self.behind_m,
            self.beam_step,
        )
