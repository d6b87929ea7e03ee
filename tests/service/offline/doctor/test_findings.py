from service.offline.doctor.findings import Report, fault, note, ok

REPORT = Report(
    "veh1.yaml",
    (
        ok("front", "sick_lms100 streams", rate_hz=49.8),
        note("clock", "unknown", "timedatectl"),
        fault("base", "/dev/corridor/create is not there", "a serial port", "plug the adapter in " * 8),
    ),
)


def test_names_and_words_are_aligned_and_lines_wrapped():
    lines = REPORT.text(width=70).splitlines()
    assert lines[0] == "ok     front  sick_lms100 streams"
    assert lines[1] == "note   clock  unknown"
    assert lines[2] == "              to do: timedatectl"
    assert lines[3].startswith("FAULT  base   /dev/corridor/create")
    assert lines[4] == "              expected: a serial port"
    assert max(map(len, lines)) <= 70
    assert lines[-1] == "1 ok, 1 note, 1 fault"


def test_only_a_terminal_gets_colours():
    assert "\x1b" not in REPORT.text()
    assert REPORT.text(colour=True).count("\x1b[1;31m") == 1


def test_a_note_alone_needs_no_mending():
    assert Report("", REPORT.findings[:2]).exit_code == 0
    assert Report("", REPORT.findings[:2]).text().endswith("nothing to mend: 1 ok, 1 note")
    assert REPORT.exit_code == 1
