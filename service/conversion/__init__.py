"""Messages of other laser devices to the scans that a mapper takes. Bytes in, LaserScan out; no IO."""

from service.conversion.config import ConversionConfig, Echo
from service.conversion.multi_echo import scan_of_echoes
from service.conversion.point_cloud import CloudConverter

__all__ = ["CloudConverter", "ConversionConfig", "Echo", "scan_of_echoes"]
