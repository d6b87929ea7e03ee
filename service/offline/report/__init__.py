"""`corridor report`: the result of a replay as one page that needs nothing else."""

from service.offline.report.page import REPORT_FILE, write_report

__all__ = ["REPORT_FILE", "write_report"]
