"""check, doctor, init, install-unit, warmup: commands before a drive."""

import argparse
import logging
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from service.cli.console import kernel_progress, print_report, print_result
from service.compile.cache import cache_folder, ensure_cache_dir, mark_warm
from service.encoding import warm_up as warm_up_encoding
from service.errors import ConfigError


def check(parsed: argparse.Namespace) -> int:
    if parsed.schema:
        return _print_schema()
    from service.config import laser_names, load_config, mapped_lasers
    from service.offline.setup.config_here import faults_here

    path: Path = parsed.config
    faults: list[str] = []
    mapped: tuple[str, ...] = ()
    others: list[str] = []
    try:
        config = load_config(path)
        mapped = mapped_lasers(config)
        others = [name for name in laser_names(config.sensors) if name not in mapped]
        faults = faults_here(config, str(path))
    except ConfigError as error:
        faults = error.faults
    if parsed.json:
        result = {"config": str(path), "ok": not faults, "faults": faults, "mapped_lasers": list(mapped)}
        print_result(result, as_json=True)
    elif faults:
        print("\n".join(faults), file=sys.stderr)
    else:
        print(f"{path}: ok; {_what_is_mapped(mapped, others)}")
    return ConfigError.exit_code if faults else 0


def _print_schema() -> int:
    from service.config_schema import schema_text

    print(schema_text(), end="")
    return 0


def _what_is_mapped(mapped: Sequence[str], others: Sequence[str]) -> str:
    if not mapped:
        return "no laser is mapped"
    beside = f"; scans of {' and '.join(others)} are published and recorded, not mapped" if others else ""
    return f"{' and '.join(mapped)} {'is' if len(mapped) == 1 else 'are'} mapped{beside}"


def doctor(parsed: argparse.Namespace) -> int:
    from service.offline.doctor.devices import Patience
    from service.offline.doctor.examine import examine

    logging.getLogger("drivers").setLevel(logging.ERROR)  # the report has its own text
    patience = Patience() if parsed.seconds is None else Patience(measure_s=parsed.seconds)
    report, exit_code = examine(parsed.config, patience=patience)
    if parsed.json:
        print_result(report.as_dict(), as_json=True)
    else:
        print(report.text(_width(), colour=sys.stdout.isatty()))
    return exit_code


def _width() -> int:
    """Of the terminal; elsewhere what reads well in a log."""
    return shutil.get_terminal_size((110, 24)).columns if sys.stdout.isatty() else 110


def init(parsed: argparse.Namespace) -> int:
    from service.offline.setup.discovery import parse_wire, serial_ports
    from service.offline.setup.new_config import write_new_config

    logging.getLogger("drivers").setLevel(logging.ERROR)  # the report has its own text
    wires = [parse_wire(wire) for wire in parsed.wires] or serial_ports()
    print(f"asking {', '.join(map(str, wires)) or 'no device'} ...", file=sys.stderr)
    written = write_new_config(wires, parsed.out, parsed.vehicle, parsed.data, parsed.seconds)
    print_report(written, parsed.json)
    return 0


def install_unit(parsed: argparse.Namespace) -> int:
    from service.offline.setup.install_unit import install_unit as install

    print_report(install(parsed.root, parsed.force, parsed.program), parsed.json)
    return 0


def warmup(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.compile.warm_up import warm_up
    from service.mapper.profiles import import_methods

    began_s = time.monotonic()
    import_methods()  # which call the kernels
    with kernel_progress() as kernels:
        warm_up_encoding()
        warm_up(progress=kernels)
    mark_warm()
    print_result(
        {"seconds": round(time.monotonic() - began_s, 3), "cache": str(cache_folder().parent)}, parsed.json
    )
    return 0
