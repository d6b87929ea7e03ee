"""Shell blocks: each line is a command that there is, called as it can be called; those on files are run."""

import gzip
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from service.cli import main
from service.cli.arguments import new_parser
from simulators.run import _parse as parse_simulate
from tests.docs.blocks import ROOT, written_in
from tests.recorded_drive import record_office
from tests.service.offline.importing.test_carmen import flaser, odom
from tests.service.recording.bags import write_ros1
from tests.service.recording.sessions import drive, write_file

SHELL = written_in("sh")
OF_THE_SYSTEM = {  # not ours, known to every reader; bash says whether the line can be one
    *("git", "cd", "cp", "man", "sudo", "systemctl", "journalctl", "python3", "pip", "source", "apt", "ros2"),
    *("pipx", "uv", "podman"),
    "export",
}  # fmt: skip
PLACEHOLDER = re.compile(r"<[a-z ]+>")
INTO_A_FILE = re.compile(r" > \S+")


def commands_of(text):
    """Lines without comments, parts joined by && apart, each as words."""
    for line in text.splitlines():
        for part in PLACEHOLDER.sub("placeholder", line).split("&&"):
            if words := shlex.split(INTO_A_FILE.sub("", part), comments=True):
                yield words


@pytest.mark.parametrize("block", SHELL, ids=map(str, SHELL))
def test_each_command_can_be_called_so(block):
    text = PLACEHOLDER.sub("placeholder", block.text)
    checked = subprocess.run(["bash", "-n"], input=text, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    for words in commands_of(block.text):
        name, *arguments = words
        match name.rpartition("/")[2]:
            case "corridor" if arguments[0] == "simulate":
                parse_simulate(arguments[1:])
            case "corridor":
                new_parser().parse_args(arguments)  # leaves by SystemExit where it refuses
            case "make":
                target = [word for word in arguments if "=" not in word] or ["help"]
                command = ["make", "-n", f"PYTHON={sys.executable}", *target]  # else make looks for one
                made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
                assert made.returncode == 0, made.stderr
            case other:
                assert other in OF_THE_SYSTEM, f"{other}: no test says whether this can be run"


@pytest.fixture
def drives(tmp_path, monkeypatch):
    """A folder with files of the names that the manual uses."""
    monkeypatch.chdir(tmp_path)
    messages = drive(60)
    for name in (
        "session.mcap",
        "later.mcap",
        "drive.mcap",
        "any_ros2_recording.mcap",
        "veh1_20261121T101500Z_0001.mcap",
    ):
        write_file(tmp_path / name, messages)
    write_ros1(tmp_path / "drive.bag", messages)
    for name in ("cut_off.mcap.active", "veh1_20261121T101500Z_0003.mcap.active"):
        write_file(tmp_path / name.removesuffix(".active"), messages, finish=False)
    log = "".join(
        odom(f"{k}.1", 0.1 * k, 0, 0) + flaser(f"{k}.2", (0.1 * k, 0, 0), ranges=[3.0] * 180)
        for k in range(9)
    )
    for name in ("intel.log.gz", "run.log.gz"):
        (tmp_path / name).write_bytes(gzip.compress(log.encode()))
    first_s = messages[1].stamp_ns // 10**9
    relation = f"{first_s}.4 {first_s}.8 0 0 0 0 0 0\n"
    for name in ("truth.relations", "TRUTH"):
        (tmp_path / name).write_text(relation)
    return tmp_path


WIRES = "--from-raw"  # the drives here have none; tests/service/offline has one that has
PAGE = "--web"  # stays until Ctrl-C; tests/service/offline/past/test_replay_page.py ends one
ON_FILES = ("replay", "import", "recover", "export", "score")
RUN = [block for block in SHELL if any(f"corridor {name} " in block.text for name in ON_FILES)]


@pytest.mark.parametrize("page", ["README.md", "docs/recording.md", "docs/importing.md"])
def test_commands_on_files_are_run(page, drives, capsys):
    """In the order of the page, each on what the one before has left."""
    ran = []
    for block in (block for block in RUN if block.page == page):
        for words in commands_of(block.text):
            if words[0] == "corridor" and words[1] in ON_FILES and not {WIRES, PAGE} & {*words}:
                assert main(words[1:]) == 0, f"{words}: {capsys.readouterr().err}"
                ran.append(words[1])
    assert ran


def test_stored_maps_are_worked_on_as_the_manual_says(tmp_path, monkeypatch, capsys):
    """From an empty folder; only a demo, which takes its seconds, is left out: its recording is put there."""
    monkeypatch.chdir(tmp_path)
    ran = []
    for block in (block for block in SHELL if block.page == "docs/maps.md"):
        for words in commands_of(block.text):
            if words[0] == "cp":
                (recording,) = tmp_path.glob(words[1])
                shutil.copy(recording, words[2])
            elif words[1] == "demo":
                record_office(Path(words[words.index("--out") + 1]) / "veh1.mcap", seed=len(ran) + 3)
            else:
                assert main(words[1:]) == 0, f"{words}: {capsys.readouterr().err}"
            ran.append(words[1])
    assert ran.count("map") >= 14
    summary = json.loads((tmp_path / "localised" / "summary.json").read_text())
    assert summary["state"]["ok"] > 0.5 * summary["scans"]
    assert main(["map", "info", "both", "--json"]) == 0
    merged = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert merged["sessions_and_pieces"] == 2
    assert main(["map", "diff", "first/map@1", "first/map@7", "--json"]) == 0  # edited and put back
    facts = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (facts["cells_changed"], facts["keyframes_gone"]) == (0, 0)
    assert (tmp_path / "diff.png").stat().st_size > 0
