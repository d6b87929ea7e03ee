import json
import re
from pathlib import Path

import pytest

from service.cli import main
from service.config import load_config
from service.config_schema import schema_text
from service.errors import StorageError, UsageError
from service.offline.setup.install_unit import FILES, SCHEMA, install_unit, own_program

PROGRAM = "/opt/corridor/venv/bin/corridor"


def test_every_file_is_put_where_it_is_looked_for(tmp_path: Path):
    done = install_unit(tmp_path, program="/usr/local/bin/corridor")
    assert sorted(done.written) == sorted(str(tmp_path / place) for place in (*FILES.values(), SCHEMA))
    unit = (tmp_path / "etc/systemd/system/corridor@.service").read_text()
    assert "\nExecStart=/usr/local/bin/corridor run /etc/corridor/%i.yaml\n" in unit
    assert PROGRAM not in unit
    assert "u corridor" in (tmp_path / "etc/sysusers.d/corridor.conf").read_text()
    assert "d /var/lib/corridor/maps 0750 corridor" in (tmp_path / "etc/tmpfiles.d/corridor.conf").read_text()
    assert 'ATTRS{idVendor}=="15d1"' in (tmp_path / "etc/udev/rules.d/60-corridor.rules").read_text()
    example = load_config(tmp_path / "etc/corridor/vehicle.yaml.example")
    named = re.search(r"\$schema=(\S+)", (tmp_path / "etc/corridor/vehicle.yaml.example").read_text())
    assert (tmp_path / "etc/corridor" / named[1]).read_text() == schema_text()
    assert str(example.sinks["recording"].directory) == "/var/lib/corridor/sessions"
    assert not list(tmp_path.rglob("*.new"))
    assert done.warning == ""
    assert "systemctl enable --now corridor@veh1" in str(done)


def test_what_was_changed_there_is_kept_and_named_unless_it_is_forced(tmp_path: Path):
    install_unit(tmp_path, program=PROGRAM)
    rules = tmp_path / "etc/udev/rules.d/60-corridor.rules"
    rules.write_text("# mine\n")
    again = install_unit(tmp_path, program=PROGRAM)
    assert (again.written, again.kept) == ([], [str(rules)])
    assert f"kept {rules}: it was changed on this machine; --force replaces it" in str(again)
    assert rules.read_text() == "# mine\n"
    forced = install_unit(tmp_path, force=True, program=PROGRAM)
    assert (forced.written, forced.kept) == ([str(rules)], [])
    assert "15d1" in rules.read_text()


def test_a_path_with_a_space_or_a_percent_sign_is_written_as_systemd_reads_it(tmp_path: Path):
    install_unit(tmp_path, program="/opt/my 100%/corridor")
    unit = (tmp_path / "etc/systemd/system/corridor@.service").read_text()
    assert '\nExecStart="/opt/my 100%%/corridor" run ' in unit


@pytest.mark.parametrize(
    "program", ["", "corridor", "./corridor", "/opt/a\nExecStart=/b", '/opt/"a"', "/opt/a\\b"]
)
def test_a_program_that_no_unit_can_start_is_wrong_usage(tmp_path: Path, program: str):
    with pytest.raises(UsageError, match=r"whole path.*write /opt/corridor/venv/bin/corridor"):
        install_unit(tmp_path, program=program)
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_the_unit_may_not_see_is_reported(tmp_path: Path):
    assert "may not look" in install_unit(tmp_path, program="/home/me/venv/bin/corridor").warning


def test_the_command_that_runs_is_the_one_that_the_unit_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["install-unit", "--root", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["program"] == own_program()
    assert own_program() in (tmp_path / "etc/systemd/system/corridor@.service").read_text()


def test_a_root_that_is_not_there_or_takes_no_files_is_reported(tmp_path: Path):
    with pytest.raises(UsageError, match="is no folder; make it"):
        install_unit(tmp_path / "nowhere")
    (tmp_path / "etc").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        install_unit(tmp_path, program=PROGRAM)
