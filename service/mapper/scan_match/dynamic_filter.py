"""Settings of how things that move are told from things that stay."""

from pydantic import Field

from drivers.section import Section
from service.kernels.static_score import StaticScoreSettings

TICK_S = 0.05  # in which it is counted how long something stands
FREE_S = 0.25  # what comes into a free cell must stay so long: a person of 0.3 m has left it by then
MIN_NEW_WEIGHT = 0.1  # of a thing just come, of one that stands 1: enough where nothing else is in view
MAX_GAIN = 2.0  # weights that fell on average are raised again, so much at most: few points are not many
BEAM_STEP = 3  # every third beam is followed, at each key frame another third


def ticks_in(time_s: float) -> int:
    return round(time_s / TICK_S)


class DynamicFilterConfig(Section):
    """When something counts in full, and when it is forgotten."""

    enough_s: float = Field(default=1.0, ge=0.0, le=6.0)  # 0: all things count alike, and stay
    behind_m: float = Field(default=0.2, gt=0.0)

    def settings(self) -> StaticScoreSettings:
        return StaticScoreSettings(
            ticks_in(self.enough_s),
            ticks_in(FREE_S),
            MIN_NEW_WEIGHT,
            MAX_GAIN,
            self.behind_m,
            BEAM_STEP,
        )
