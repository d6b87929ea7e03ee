"""How much faster than real time a real building is replayed."""

from service.offline.replay.replay import ReplayOptions, replay
from tests.shared_data import SHARED

FR079 = SHARED / "datasets" / "fr079" / "fr079.mcap"


def measure() -> list[tuple[str, float, str]]:
    """Nothing where the recording is not at hand."""
    if not FR079.exists():
        print(f"replay    left out: {FR079} is not there; set CORRIDOR_SHARED")
        return []
    summary = replay([FR079], ReplayOptions()).summary
    return [
        ("fr079, 360 beams: realtime factor", summary["realtime_factor"], "x"),
        ("fr079, 360 beams: scan p50", summary["scan_ms"]["p50"], "ms"),
        ("fr079, 360 beams: scan p99", summary["scan_ms"]["p99"], "ms"),
        ("fr079: peak memory", summary["peak_rss_mb"], "MB"),
    ]
