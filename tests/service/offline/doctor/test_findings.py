from service.offline.doctor.findings import Report, fault, note, ok

REPORT = Report(
    "veh1.yaml",
    (
        ok("front", "sick_lms100 streams", rate_hz=49.8),
        note("clock", "unknown", "timedatectl"),
        fault("base", "/dev/corridor/create is not there", "a serial port", "plug the adapter in " * 8),
    ),
)


def test_only_a_terminal_gets_colours():
    assert "\x1b" not in REPORT.text()
    assert REPORT.text(colour=True).count("\x1b[1;31m") == 1
