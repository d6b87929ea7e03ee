import re
import shutil
import subprocess
from pathlib import Path

import pytest

from service.cli import main
from service.cli.arguments import new_parser
from service.cli.manual import pages

PAGES = dict(pages(new_parser()))


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff: apt install groff")
def test_groff_finds_no_fault_in_the_pages_and_loses_no_word():
    command = ["groff", "-man", "-ww", "-Tascii", "-P-c", "-P-b", "-P-u", "-rLL=200n"]
    ran = subprocess.run(command, input="".join(PAGES.values()), capture_output=True, text=True, check=True)
    assert ran.stderr == ""
    shown = re.sub(r"\s+", " ", ran.stdout)
    assert ".mcap, .bag of ROS 1, .db3 or the folder of a ROS 2 bag" in shown  # begins with a dot
    assert "corridor replay recordings through the same mapper" in shown
    assert "exit codes: 0 done, 1 failed, 64 wrong usage" in shown


def test_the_command_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["man", str(tmp_path / "man1")]) == 0
    assert {path.stem for path in (tmp_path / "man1").iterdir()} == PAGES.keys()
    assert (tmp_path / "man1" / "corridor-replay.1").read_text() == PAGES["corridor-replay"]
    assert "corridor-replay.1" in capsys.readouterr().out
