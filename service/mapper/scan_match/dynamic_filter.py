"""Settings of the dynamic filter: static and dynamic objects by the static score."""

from pydantic import Field

from drivers.section import Section
from service.kernels.static_score import StaticScoreSettings

TICK_S = 0.05  # unit of the static score
FREE_S = 0.25  # an object in a free cell must stay this long: a person of 0.3 m has left it by then
MIN_NEW_WEIGHT = 0.1  # of a new object over a static one: enough where nothing else is in view
MAX_GAIN = 2.0  # limit of the rescaling of weights: few points do not become many
BEAM_STEP = 3  # every third beam is traced, another third at each key frame


def ticks_in(time_s: float) -> int:
    return round(time_s / TICK_S)


class DynamicFilterConfig(Section):
    """When an object counts fully, and when it is removed."""

    enough_s: float = Field(default=1.0, ge=0.0, le=6.0)  # 0: no dynamic filter
    behind_m: float = Field(default=0.2, gt=0.0)

    def settings(self) -> StaticScoreSettings:
        return StaticScoreSettings(
            ticks_in(self.enough_s), ticks_in(FREE_S), MIN_NEW_WEIGHT, MAX_GAIN, self.behind_m, BEAM_STEP
        )
