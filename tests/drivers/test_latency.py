"""Every sensor's config takes the same latencies, and what comes so late is mapped."""

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.latency import MAX_LATENCY_MS, MIN_LATENCY_MS
from drivers.sick_lms100.config import Lms100Config
from drivers.xsens_mtig.config import XsensMtigConfig
from service.mapper.pipeline import MAX_BEHIND_NS

SLOWEST_SWEEP_MS = 80.0  # of a LUX at 12.5 Hz


@pytest.mark.parametrize(
    "config", [Lms100Config, HokuyoUtm30lxConfig, IbeoLuxConfig, XsensMtigConfig, IrobotCreateConfig]
)
def test_a_latency_is_between_50_ms_early_and_200_late(config: type[BaseModel]) -> None:
    field = config.model_fields["latency_ms"]
    adapter: TypeAdapter[float] = TypeAdapter(field.rebuild_annotation())
    for value in (MIN_LATENCY_MS, 0.0, MAX_LATENCY_MS):
        assert adapter.validate_python(value) == value
    for value in (MIN_LATENCY_MS - 1.0, MAX_LATENCY_MS + 1.0):
        with pytest.raises(ValidationError):
            adapter.validate_python(value)
    assert field.default == 0.0


def test_a_scan_of_the_greatest_latency_is_mapped() -> None:
    assert (MAX_LATENCY_MS + SLOWEST_SWEEP_MS) * 1e6 <= MAX_BEHIND_NS
