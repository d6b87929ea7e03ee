"""check, doctor, warmup: what one does before a drive."""

import argparse
import logging
import shutil
import sys
from pathlib import Path

from service.cli.console import print_result
from service.errors import ConfigError
from service.kernel_cache import ensure_cache_dir


def config_path(parsed: argparse.Namespace) -> Path:
    """`run CONFIG.yaml` and `run --config CONFIG.yaml` are the same."""
    path: Path = parsed.config if parsed.config is not None else parsed.config_option
    return path


def check(parsed: argparse.Namespace) -> int:
    from service.config import load_config

    path = config_path(parsed)
    faults: list[str] = []
    try:
        load_config(path)
    except ConfigError as error:
        faults = error.faults
    if parsed.json:
        print_result({"config": str(path), "ok": not faults, "faults": faults}, as_json=True)
    elif faults:
        print("\n".join(faults), file=sys.stderr)
    else:
        print(f"{path}: ok")
    return ConfigError.exit_code if faults else 0


def doctor(parsed: argparse.Namespace) -> int:
    from service.offline.doctor.devices import Patience
    from service.offline.doctor.examine import examine

    logging.getLogger("drivers").setLevel(logging.ERROR)  # the report says it in its own words
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


def warmup(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.offline.warmup import warm_up

    print_result(warm_up(), parsed.json)
    return 0
