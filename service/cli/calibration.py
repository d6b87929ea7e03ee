"""calibrate: a drive to a config that fits the vehicle."""

import argparse
import json
from dataclasses import asdict

from service.cli.console import progress
from service.compile.cache import ensure_cache_dir
from service.log_format import printable


def calibrate(parsed: argparse.Namespace) -> int:
    ensure_cache_dir()
    from service.cli.recordings import choice_of
    from service.offline.calibrate.calibrate import calibrate as calibrate_by
    from service.offline.importing.session_file import refuse_to_overwrite
    from service.offline.writing import complete_files, refuse_unwritable_file

    if parsed.out is not None:
        for path in parsed.files:
            refuse_to_overwrite(path, parsed.out)
        refuse_unwritable_file(parsed.out)
    with progress("calibrate") as shown:
        done = calibrate_by(parsed.files, parsed.config, parsed.reference, shown, choice_of(parsed))
    if parsed.out is not None:
        with complete_files(parsed.out) as path:
            path.write_text(done.config or done.patch, encoding="utf-8")
    print(json.dumps(asdict(done), allow_nan=False) if parsed.json else printable(done))
    return 0
