"""What a fake Hokuyo laser is: the replies of its model, and the state it is switched on in. No I/O."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from drivers.hokuyo_utm30lx.models import ModelName

Wire = Literal["usb", "ethernet"]

COMMANDS = {  # and their lengths with parameters
    **dict.fromkeys(("VV", "PP", "II", "BM", "QT", "RS", "RT", "RB"), 2),
    **{"TM": 3, "SS": 8, "CR": 4, "HS": 3, "DB": 4},
    **dict.fromkeys(("GD", "GS", "GE"), 12),
    **dict.fromkeys(("MD", "MS", "ME"), 15),
}
ETHERNET_COMMANDS = {"%ST": 3, "%SL": 3}
ECHO_COMMANDS = {**dict.fromkeys(("HD", "HE"), 12), **dict.fromkeys(("ND", "NE"), 15)}


class Replies(NamedTuple):
    """VV, PP and II, and which scans it has; as a UTM-30LX by USB, recorded in gbiggs/hokuyoaist."""

    vendor: str = "Hokuyo Automatic Co.,Ltd."
    product: str = "SOKUIKI Sensor TOP-URG UTM-30LX"  # PROD
    model: str = "UTM-30LX(Hokuyo Automatic Co.,Ltd.)"  # MODL
    firmware: str = "P.1.05(17/Apr./2009)"
    protocol: str = "SCIP 2.0"
    speed: str = "Initial(2400[rpm])<-Default setting by user"  # SCSP
    normal: str = "Sensor works well."  # STAT
    abnormal: str = "Trouble!! Error No. =[00->33]"
    distance_min_mm: int = 23
    distance_max_mm: int = 60_000
    steps_per_turn: int = 1440
    first_step: int = 0
    last_step: int = 1080
    front_step: int = 540
    speed_rpm: int = 2400
    no_return_mm: int = 1  # 65533 was seen of an EW too
    commands: dict[str, int] = COMMANDS
    locks_up_at: tuple[str, ...] = ()  # commands after which it answers nothing until its power is cut


# UTM-30LX-EW: seqsense/urg_stamped. UST-10LX, URG-04LX-UG01: VV and PP as public drivers print them, II as
# the others of their wire; the lock-up: ros-drivers/urg_c, pull request 4.
_USB = Replies()
_EW = Replies(
    vendor="Hokuyo Automatic Co., Ltd.",
    product="UTM-30LX-EW",
    model="UTM-30LX-EW",
    firmware="1.1.0 (2011-09-30)",
    protocol="SCIP 2.2",
    speed="2400",
    normal="Stable 000 no error.",
    abnormal="Error 033",
    commands=COMMANDS | ETHERNET_COMMANDS | ECHO_COMMANDS,
)
REPLIES: dict[tuple[str, str], Replies] = {
    ("utm_30lx", "usb"): _USB,
    ("utm_30lx", "ethernet"): _EW,
    ("ust", "ethernet"): _EW._replace(
        product="UST-10LX",
        model="UST-10LX",
        firmware="4.0.2-A",
        distance_min_mm=20,
        distance_max_mm=30_000,
        no_return_mm=65_533,
        commands=COMMANDS | ETHERNET_COMMANDS,
    ),
    ("urg_04lx_ug01", "usb"): _USB._replace(
        product="SOKUIKI Sensor URG-04LX-UG01(Simple-URG)",
        model="URG-04LX-UG01(Simple-URG)(Hokuyo Automatic Co.,Ltd.)",
        firmware="3.4.03(17/Dec./2012)",
        speed="Initial(600[rpm])<-Default setting by user",
        distance_min_mm=20,
        distance_max_mm=5_600,
        steps_per_turn=1024,
        first_step=44,
        last_step=725,
        front_step=384,
        speed_rpm=600,
        no_return_mm=0,
        locks_up_at=("GE", "ME", *ECHO_COMMANDS),
    ),
}


@dataclass(frozen=True, slots=True)
class Utm30lxSetup:
    """Model, stored settings and faults of this unit."""

    wire: Wire = "usb"
    model: ModelName = "utm_30lx"
    product: str = ""  # what it calls itself; "": as its model does
    serial_number: str = "00903971"
    last_step: int | None = None  # None: as its model states in PP
    boot_ns: int = 0  # the device does not answer; a real one takes 1 to 2 s by USB, several by Ethernet
    warm_up_ns: int = 0  # after that: laser and scans are answered 0M
    scip_1: bool = False  # until it gets SCIP2.0
    clock_start_ms: int = 0  # at power-up; near 2**24 it soon wraps
    clock_drift_ppm: float = 0.0  # positive: the device's clock runs fast
    motor_speed: float = 1.0  # of nominal; one was seen to take 25.05 ms a turn
    stamps_rear: bool = False  # the moment the mirror looks back, instead of step 0
    no_return_mm: int | None = None  # value of a beam without echo; None: as its model does
    sums_count_semicolons: bool = False
    refused: frozenset[str] = frozenset()  # commands it does not know: ME, ND ...; also "cluster", "skip"
    cuts_scan_on_quit: bool = False  # QT is answered in the middle of a scan
