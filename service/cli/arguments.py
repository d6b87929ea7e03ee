"""The command line alone: name and arguments of each command."""

import argparse
import sys
from pathlib import Path
from typing import Any, NoReturn

from service.cli.argument_types import (
    PROFILES,
    WORLDS,
    OneOf,
    local_path,
    map_and_version,
    port,
    positive,
    positive_int,
    rate,
)
from service.cli.fleet import add_fleet
from service.cli.map_arguments import add_maps
from service.cli.recordings import add_choice
from service.cli.security import add_security
from service.cli.version import ShowVersion
from service.errors import UsageError, shortened

EPILOG = """exit codes: 0 done, 1 failed, 64 wrong usage, 65 bad input file, 74 I/O error, 78 bad config.
Results go to stdout, progress and logs to stderr."""
RECORDINGS = (
    ".mcap, .bag of ROS 1, .db3 or the folder of a ROS 2 bag; each also packed (.zstd, .gz, .bz2, .xz, .lz4)"
)
FORMATS = ("pgm", "png", "geotiff", "svg", "dxf", "geojson", "kml", "tum", "csv", "g2o", "ply", "pcd")


class Parser(argparse.ArgumentParser):
    """Exits with 64 on wrong usage, as sysexits.h has it, instead of argparse's 2."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(UsageError.exit_code, f"{self.prog}: {shortened(message)}\n")


def new_parser() -> Parser:
    parser = Parser(
        prog="corridor",
        description="Live 2D laser mapping for a vehicle.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action=ShowVersion, help="version, commit of a checkout, key of the compiled kernels"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="log every detail")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_demo(commands)
    _add_simulate(commands)
    _add_replay(commands)
    _add_import(commands)
    _add_export(commands)
    _add_report(commands)
    _add_calibrate(commands)
    _add_tune(commands)
    _add_view(commands)
    _add_score(commands)
    add_maps(commands, _add)
    _add_site(commands)
    _add_check_and_doctor(commands)
    _add_recover(commands)
    _add_init(commands)
    _add_install_unit(commands)
    add_security(commands, _add)
    add_fleet(commands, _add)
    _add(commands, "warmup", "compile the kernels and keep them in the cache")
    completion = _add(commands, "completion", "print the script by which a shell completes this command line")
    completion.add_argument("shell", choices=("bash", "zsh", "fish"))
    man = _add(commands, "man", "write the manual pages of the program and of its commands, for `man`")
    man.add_argument("folder", type=local_path, metavar="DIR", help="share/man/man1 of a prefix, say")
    return parser


def _add_run(commands: Any) -> None:
    run = _add(
        commands, "run", "the live service: drivers, mapping, Zenoh, recording, until SIGTERM or Ctrl-C"
    )
    run.add_argument("config", type=local_path, metavar="CONFIG.yaml")


def _add_demo(commands: Any) -> None:
    demo = _add(commands, "demo", "fake devices and the service on this machine, until Ctrl-C")
    demo.add_argument("--seconds", type=positive, metavar="S", help="end after S seconds")
    demo.add_argument(
        "--world",
        type=OneOf("world", WORLDS),
        metavar="W",
        help=f"the world to drive in (default: office): {', '.join(WORLDS)}",
    )
    _add_profile(demo, "mapping profile (default: corridor)")
    demo.add_argument(
        "--port",
        type=port,
        metavar="N",
        help="TCP port of 127.0.0.1 at which Zenoh listens (default: 7447, any free one where that is taken)",
    )
    demo.add_argument(
        "--web-port",
        type=port,
        metavar="N",
        help="TCP port of 127.0.0.1 for the operator's page (default: 8080, or any free one)",
    )
    demo.add_argument("--seed", type=int, default=1, help="of the world and its noise (default: 1)")
    demo.add_argument(
        "--faults", type=local_path, metavar="FILE", help="what goes wrong with the devices, and when"
    )
    demo.add_argument(
        "--out",
        type=local_path,
        default=Path("out"),
        metavar="DIR",
        help="sessions and map go here (default: out)",
    )
    demo.add_argument("--no-web", action="store_true", help="serve no operator's page")


def _add_simulate(commands: Any) -> None:
    simulate = commands.add_parser(
        "simulate", help="only the fake devices; takes what `python -m simulators` takes", add_help=False
    )
    simulate.add_argument("arguments", nargs=argparse.REMAINDER)


def _add_replay_input(replay: argparse.ArgumentParser) -> None:
    """Recordings, and how they are mapped."""
    replay.add_argument("files", nargs="+", metavar="FILE", help=f"{RECORDINGS}; a path or a URL")
    _add_profile(replay, "map with this profile instead of the recorded one")
    replay.add_argument(
        "--config",
        type=local_path,
        metavar="CONFIG.yaml",
        help="map with its sensors and mapping instead of the recorded ones, and by its section replay; the "
        "other sections are not read",
    )
    replay.add_argument(
        "--out",
        metavar="DIR",
        help="trajectories, map and summary go here, to a folder or a URL (several files, --jobs or "
        "--cluster: a folder each); default: out/replay_<name>",
    )
    replay.add_argument(
        "--rate",
        type=rate,
        default=0.0,
        metavar="max|N",
        help="N times real time, or as fast as it goes (default: max)",
    )
    replay.add_argument(
        "--map",
        type=map_and_version,
        metavar="MAP[@VERSION]",
        help="begin in this stored map (default: in the version that the recording began in, where it began "
        "in this map, else in the newest)",
    )
    replay.add_argument("--localize", action="store_true", help="only localise in it: it stays as it is")
    replay.add_argument(
        "--from-raw",
        action="store_true",
        help="run the recorded bytes (/<sensor>/raw) through the drivers again and map what comes out",
    )


def _add_replay(commands: Any) -> None:
    replay = _add(
        commands, "replay", "recordings through the same mapper; same input, same output, bit for bit"
    )
    _add_replay_input(replay)
    _add_engine(replay)
    replay.add_argument(
        "--again",
        action="store_true",
        help="with --jobs or --cluster: replay, too, what is done already with the same input and config",
    )
    replay.add_argument(
        "--web",
        action="store_true",
        help="show the map on the operator's page as it grows, until Ctrl-C; the result is the same",
    )
    add_choice(replay)
    replay.add_argument(
        "--mcap",
        action="append_const",
        dest="extras",
        const="mcap",
        default=[],
        help="write session.mcap, too: poses, map, loops and states for Foxglove and rerun",
    )
    replay.add_argument(
        "--report",
        action="append_const",
        dest="extras",
        const="report",
        help="write report.html, too: the result as one page with pictures",
    )
    replay.add_argument("--paused", action="store_true", help="with --web: begin when the page says so")
    _add_listen(replay)


def _add_import(commands: Any) -> None:
    import_ = commands.add_parser("import", help="a foreign log to a session")
    kinds = import_.add_subparsers(dest="kind", metavar="KIND", required=True)
    carmen = _add(kinds, "carmen", "a CARMEN log, plain or .gz")
    carmen.add_argument("log", type=local_path, metavar="LOG")
    carmen.add_argument("out", type=local_path, metavar="OUT.mcap")
    carmen.add_argument(
        "--odometry",
        choices=("auto", "logged", "none"),
        default="auto",
        help="auto: poses of a corrected log are a result and no odometry; logged: take them all the same",
    )

    rosbag = _add(kinds, "rosbag", "a bag of ROS 1 or ROS 2")
    rosbag.add_argument("log", type=local_path, metavar="BAG", help=RECORDINGS)
    rosbag.add_argument("out", type=local_path, metavar="OUT.mcap")
    add_choice(rosbag)


def _add_export(commands: Any) -> None:
    export = _add(commands, "export", "a session, a map or a replay's folder to a file other programs read")
    export.add_argument("input", type=local_path, metavar="INPUT")
    export.add_argument("--format", choices=FORMATS, required=True)
    export.add_argument("--out", type=local_path, required=True, metavar="PATH")


def _add_report(commands: Any) -> None:
    report = _add(
        commands, "report", "a replay's folder as one HTML page: map, path, states, loops, sensors, warnings"
    )
    report.add_argument("result", type=local_path, metavar="RESULT")
    report.add_argument(
        "--out",
        type=local_path,
        metavar="FILE.html",
        help="write it here (default: report.html in the folder)",
    )


def _add_calibrate(commands: Any) -> None:
    calibrate = _add(
        commands, "calibrate", "mountings, wheel scale, time offsets and latencies of a recorded drive"
    )
    calibrate.add_argument("files", type=local_path, nargs="+", metavar="FILE", help=RECORDINGS)
    calibrate.add_argument(
        "--config",
        type=local_path,
        metavar="CONFIG.yaml",
        help="the config to mend (default: the recorded one)",
    )
    calibrate.add_argument(
        "--out",
        type=local_path,
        metavar="CALIBRATED.yaml",
        help="write the mended config, or the patch without one",
    )
    calibrate.add_argument(
        "--reference", metavar="LASER", help="whose clock and place the others' are compared with"
    )
    add_choice(calibrate)


def _add_tune(commands: Any) -> None:
    tune = _add(commands, "tune", "settings of a profile, by a search over recorded drives (extra tune)")
    tune.add_argument("files", nargs="+", metavar="FILE", help=f"{RECORDINGS}; a path or a URL")
    by = tune.add_mutually_exclusive_group(required=True)
    by.add_argument(
        "--truth",
        type=local_path,
        nargs="+",
        metavar="TRUTH",
        help="a TUM or .relations file for each session, or a folder of files named like them",
    )
    by.add_argument(
        "--self", action="store_true", help="without a truth: walls of different passes, entropy, states"
    )
    tune.add_argument(
        "--parameter",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH]",
        help="a setting to search; one each time (default: those of motion_model and matcher; from a tenth "
        "to ten times the present value)",
    )
    _add_profile(tune, "tune this profile instead of the recorded one")
    tune.add_argument(
        "--config",
        type=local_path,
        metavar="CONFIG.yaml",
        help="the present settings (default: the recorded ones)",
    )
    tune.add_argument("--trials", type=positive_int, default=30, metavar="N", help="default: 30")
    tune.add_argument("--seed", type=positive_int, default=1, metavar="N", help="of the search (default: 1)")
    tune.add_argument(
        "--all", action="store_true", help="search on all sessions (default: every second one is held out)"
    )
    tune.add_argument(
        "--out",
        default="out/tune",
        metavar="DIR",
        help="page, patch, results and the state of the search, which goes on there (default: out/tune)",
    )
    _add_engine(tune)
    add_choice(tune)


def _add_site(commands: Any) -> None:
    works = commands.add_parser("site", help="one map of all drives of a site").add_subparsers(
        dest="work", metavar="WORK", required=True
    )
    build = _add(works, "build", "map all sessions, find how they lie to each other, and solve them as one")
    build.add_argument(
        "sessions",
        nargs="*",
        metavar="SESSION",
        help=f"{RECORDINGS}; the result of a replay; a stored map; a folder of them, or a URL of recordings",
    )
    build.add_argument(
        "--out",
        type=local_path,
        required=True,
        metavar="MAP",
        help="folder of the site's map; what is there already is kept, and the sessions are added",
    )
    build.add_argument(
        "--join",
        action="append",
        default=[],
        metavar="NAME",
        help="a session that is of this place although so much has changed in it; one each time",
    )
    build.add_argument(
        "--forget",
        action="append",
        default=[],
        metavar="NAME",
        help="a session that was left out, and is not named any more; one each time",
    )
    build.add_argument(
        "--config", type=local_path, metavar="CONFIG.yaml", help="map recordings with it instead"
    )
    _add_engine(build)
    add_choice(build)


def _add_view(commands: Any) -> None:
    view = _add(
        commands, "view", "a stored map, a result or a recording on the operator's page, until Ctrl-C"
    )
    view.add_argument(
        "source",
        type=local_path,
        nargs="+",
        metavar="RESULT|MAP|FILE",
        help="the folder of a result or a map, the .yaml of a ROS map, or the files of one recording: "
        "any of its moments",
    )
    _add_listen(view)
    view.add_argument("--rerun", action="store_true", help="in rerun's viewer instead (extra rerun)")
    view.add_argument(
        "--save",
        type=local_path,
        metavar="FILE.rrd",
        help="with --rerun: write a recording for it, open nothing",
    )


def _add_score(commands: Any) -> None:
    score = _add(commands, "score", "a trajectory against the truth: ATE, RPE, closure, relations")
    score.add_argument("estimate", type=local_path, metavar="EST.tum")
    score.add_argument(
        "truth", type=local_path, metavar="TRUTH", help="a TUM file, or .relations (Kuemmerle et al. 2009)"
    )
    score.add_argument(
        "--shift-s", type=float, default=0.0, metavar="S", help="add S to the estimate's stamps"
    )
    score.add_argument(
        "--offset-x", type=float, default=0.0, metavar="M", help="score a frame M metres ahead"
    )
    score.add_argument(
        "--pairs", choices=("all", "near"), default="all", help="near: only pairs within 0.12 s of a scan"
    )


def _add_check_and_doctor(commands: Any) -> None:
    check = _add(commands, "check", "validate a config; every fault with its place and what to write instead")
    given = check.add_mutually_exclusive_group(required=True)
    given.add_argument("config", type=local_path, nargs="?", metavar="CONFIG.yaml")
    given.add_argument(
        "--schema", action="store_true", help="print the JSON schema of a config instead, for editors"
    )

    doctor = _add(
        commands, "doctor", "look at ports, rights, devices, clocks, disk, cache; what is wrong, what to do"
    )
    doctor.add_argument("config", type=local_path, nargs="?", metavar="CONFIG.yaml")
    doctor.add_argument(
        "--seconds",
        type=positive,
        metavar="S",
        help="measure each device so long once it streams (default: 3)",
    )


def _add_recover(commands: Any) -> None:
    recover = _add(commands, "recover", "a session whose writer died, to a valid MCAP")
    recover.add_argument("file", type=local_path, metavar="FILE.mcap.active")


def _add_init(commands: Any) -> None:
    init = _add(commands, "init", "write a commented config for the devices that answer")
    init.add_argument(
        "wires",
        nargs="*",
        metavar="[TYPE=]WIRE",
        help="a host (192.168.0.1, host:2112), a device file (/dev/ttyUSB0) or usb, each also with the type "
        "of its sensor in front; without any: the serial ports of this machine",
    )
    init.add_argument(
        "--out", type=local_path, default=Path("vehicle.yaml"), metavar="FILE", help="default: vehicle.yaml"
    )
    init.add_argument("--vehicle", default="veh1", metavar="NAME", help="default: veh1")
    init.add_argument(
        "--data",
        type=local_path,
        default=Path("/var/lib/corridor"),
        metavar="DIR",
        help="sessions and maps go below it (default: /var/lib/corridor)",
    )
    init.add_argument(
        "--seconds", type=positive, default=8.0, metavar="S", help="for each type's answer (default: 8)"
    )


def _add_install_unit(commands: Any) -> None:
    install = _add(commands, "install-unit", "systemd unit, sysusers, tmpfiles, udev rules, example config")
    install.add_argument(
        "--root",
        type=local_path,
        default=Path("/"),
        metavar="DIR",
        help="of the system to set up (default: /)",
    )
    install.add_argument("--program", metavar="PATH", help="that the unit starts (default: this command)")
    install.add_argument("--force", action="store_true", help="replace files that were changed there")


def _add(commands: Any, name: str, help_text: str) -> argparse.ArgumentParser:
    added: argparse.ArgumentParser = commands.add_parser(name, help=help_text, description=help_text)
    added.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else")
    return added


def _add_profile(parser: argparse.ArgumentParser, help_text: str) -> None:
    parser.add_argument(
        "--profile", type=OneOf("profile", PROFILES), metavar="P", help=f"{help_text}: {', '.join(PROFILES)}"
    )


def _add_engine(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=positive_int,
        metavar="N",
        help="so many sessions at the same time, each in a process of this machine",
    )
    where.add_argument(
        "--cluster",
        metavar="WHERE",
        help="each session as a task of Dask (extra cluster): local:N, slurm:N or the address of a "
        "scheduler, tcp://HOST:8786",
    )


def _add_listen(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--listen",
        default="127.0.0.1:8080",
        metavar="HOST:PORT",
        help="where the page is served (default: 127.0.0.1:8080; port 0: any free one)",
    )
