"""A plugin of pytest: it names each failure at once, as a run that hangs has no summary."""

from typing import Any

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    report = yield
    if report.failed:
        reporter: Any = item.config.pluginmanager.get_plugin("terminalreporter")
        reason = call.excinfo.exconly(tryshort=True) if call.excinfo else str(report.longrepr)
        reporter.ensure_newline()
        reporter.write_line(f"FAILED {report.nodeid} - {reason.splitlines()[0]}")
    return report
