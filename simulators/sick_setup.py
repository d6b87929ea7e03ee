"""What a fake SICK scanner is: its model, and the state in which it is switched on. No I/O."""

from dataclasses import dataclass, field
from typing import NamedTuple

from drivers.sick_lms100.models import ModelName
from drivers.sick_lms100.protocol import Dialect
from drivers.sick_lms100.telegrams import OutputRange, ScanConfig, ScanDataConfig


class Traits(NamedTuple):
    """Properties of a model that the driver does not use."""

    ident: str  # DeviceIdent
    reach_m: float
    zero_index_after_sweep: bool = True  # recorded of an LMS111, a TiM551 and a TiM781S


TRAITS: dict[str, Traits] = {
    "lms1xx": Traits("LMS10x_FieldEval", 20.0),
    "lms5xx": Traits("LMS511_FieldEval", 65.0, zero_index_after_sweep=False),
    "tim5xx": Traits("TiM571", 25.0),
    "tim7xx": Traits("TiM781", 25.0),
}


@dataclass(frozen=True, slots=True)
class Lms100Setup:
    """Model, firmware, stored settings and faults of this unit."""

    model: ModelName = "lms1xx"
    ident: str = ""  # what it calls itself; "": as its model does
    dialect: Dialect = Dialect.ASCII
    scan: ScanConfig | None = None  # None: as its model leaves the factory
    output_range: OutputRange | None = None
    echo_filter: int = 0  # FREchoFilter, where the model has it
    scan_data: ScanDataConfig = field(default_factory=lambda: ScanDataConfig(1, False, False))
    measuring: bool = True  # as after a power-up long ago
    serial_number: int = 18_090_362
    boot_ns: int = 0  # the port is open but the device does not answer
    start_delay_ns: int = 200_000_000  # from standstill to measuring; a real one takes seconds
    reconfigure_delay_ns: int = 300_000_000  # a real one takes 30 s
    first_writes_refused: int = 0  # with error 4, as after power-up
    refused: frozenset[str] = frozenset()  # settings by their names; V1.23 denies LMPoutputRange (error A)
    kept: frozenset[str] = frozenset()  # settings whose change is accepted and not made
    firmware: str = "V1.80.2"
    clock_start_us: int = 0  # counter at power-up; near 2**32 it soon wraps
    clock_drift_ppm: float = 0.0  # positive: the device's clock runs fast
    motor_speed: float = 0.9955  # of nominal; the recorded LMS111 turns with 49.6 to 49.8 Hz
    zero_index_after_sweep: bool | None = None  # False: at the first beam, as documented; None: as recorded
    scale: float = 1.0  # mm per digit
    reach_m: float | None = None  # None: the model's
