"""The fault campaign: `python -m tests.chaos [--seconds S] [--seed N] [--only DEVICE]`.

Every driver against its pretended device in virtual time, then the whole machine for a minute in real time.
Prints a table; exits 1 where something did not come back.
"""

import argparse
import sys
import time

from service.compile.cache import ensure_cache_dir


def main() -> int:
    ensure_cache_dir()
    from tests.chaos.campaign import campaign
    from tests.chaos.machine import run_machine
    from tests.drivers.faulty_devices import BENCHES

    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="virtual, of each device and kind (default 60)"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", action="append", choices=sorted(BENCHES), default=[])
    parser.add_argument(
        "--machine-seconds", type=float, default=60.0, help="real; 0: leave it out (default 60)"
    )
    options = parser.parse_args()
    failed = 0
    began_s = time.monotonic()
    print(f"{'device':17} {'fault':15} {'times':>5} {'harmed':>6} {'links':>5} {'frames':>6} {'gap s':>6}")
    for row in campaign(options.seconds, options.seed, options.only or list(BENCHES)):
        failed += bool(row.defect)
        print(
            f"{row.device:17} {row.faults:15} {row.times:5} {row.harmed:6} {row.connects:5} {row.frames:6} "
            f"{row.longest_gap_s:6.2f}  {row.defect or 'ok'}",
            flush=True,
        )
    if options.machine_seconds:
        defect, rmse_m = run_machine(options.machine_seconds, options.seed)
        failed += bool(defect)
        print(f"whole machine, {options.machine_seconds:g} s of all kinds: {defect or 'ok'}, {rmse_m} m off")
    print(f"{failed} did not come back; {time.monotonic() - began_s:.0f} s, seed {options.seed}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
