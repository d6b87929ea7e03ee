"""A mapper's process that misbehaves as the environment says; see __init__.py."""

import os
import sys
from typing import Any

from drivers.frames import Frame, LaserScan
from service.compile.signatures import Job
from service.compile.warm_up import KernelProgress
from service.mapper.pipeline import Mapper
from service.outputs import MapperOutput
from service.runtime import mapper_process, standby_schedule
from tests.service.runtime.mappers import FATAL_RANGE_M, HOW, LOADED

STANDBY_EVERY_NS = 300_000_000  # one comes soon

process = Mapper.process


def strange(self: Mapper[Any], frame: Frame) -> MapperOutput | None:
    is_fatal = isinstance(frame, LaserScan) and abs(float(frame.range_m[0]) - FATAL_RANGE_M) < 1e-3
    how = os.environ[HOW]
    if is_fatal and how == "raises":
        raise IndexError("no such tile")
    if is_fatal and how == "hangs":
        os.read(os.pipe()[0], 1)  # no one writes
    while is_fatal and how == "computes":
        pass
    return process(self, frame)


def no_kernels(back_end_elsewhere: bool, progress: KernelProgress, leaves_seldom: bool = False) -> list[Job]:
    if os.environ[HOW] == "does not compile":
        raise TypeError("cannot lower")
    if os.environ[HOW] == "compiles for ever":
        jobs = [Job("service.kernels.match", name, 0, 100) for name in ("match_scan", "another")]
        progress.expect(jobs)
        progress.done(jobs[0])
        os.read(os.pipe()[0], 1)
    if os.environ[HOW] == "says what it loads":
        with open(os.environ[LOADED], "a", encoding="utf-8") as loaded:
            loaded.write("once\n")
    return []


if __name__ == "__main__":
    Mapper.process = strange  # type: ignore[method-assign]
    mapper_process.warm_up_kernels = no_kernels
    standby_schedule.INTERVAL_NS = STANDBY_EVERY_NS
    code = mapper_process.main()
    sys.stderr.flush()
    os._exit(code)
