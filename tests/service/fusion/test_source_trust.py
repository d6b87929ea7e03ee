import pytest

from service.fusion.source_trust import Noise, SourceTrust

MS = 1_000_000
SURE = (0.001, 0.0003)
STEP_NS = 50 * MS


def wheels() -> SourceTrust:
    return SourceTrust(Noise(0.02, 0.10, 0.02, 0.15, 0.02))


def drive(
    trust: SourceTrust, steps: int, said_m: float, found_m: float, guessed_m: float, step_ns: int = STEP_NS
) -> None:
    for k in range(steps):
        trust.learn(k * step_ns, (k + 1) * step_ns, (said_m, 0.0), (found_m, 0.0), (guessed_m, 0.0), SURE)


def test_wheels_within_their_noise_are_trusted() -> None:
    trust = wheels()
    drive(trust, 100, 0.056, 0.05, 0.05)
    assert trust.is_trusted


def test_wheels_that_stand_while_the_vehicle_drives_are_out_within_half_a_second() -> None:
    trust = wheels()
    drive(trust, 10, 0.0, 0.03, 0.03)
    assert not trust.is_trusted
    assert trust.contradiction() == "0.00 m and 0.0 deg against 0.15 m and 0.0 deg"


def test_a_single_slip_costs_nothing() -> None:
    trust = wheels()
    drive(trust, 5, 0.10, 0.05, 0.08)  # the guess was off, too
    drive(trust, 30, 0.05, 0.05, 0.05)
    drive(trust, 5, 0.10, 0.05, 0.08)
    assert trust.is_trusted


def test_who_was_out_comes_back_by_being_right_about_motion() -> None:
    trust = wheels()
    drive(trust, 20, 0.0, 0.03, 0.03)
    drive(trust, 500, 0.0, 0.0, 0.0)  # right, but parked
    assert not trust.is_trusted
    drive(trust, 5 * 41, 0.05, 0.05, 0.05)
    assert trust.is_trusted


@pytest.mark.parametrize("guessed_m", [0.0, -0.1])
def test_where_the_last_speed_would_be_no_better_poor_wheels_stay(guessed_m: float) -> None:
    trust = wheels()
    drive(trust, 50, 0.0, 0.05, guessed_m)
    assert trust.is_trusted


def test_slow_scans_are_no_judge() -> None:
    trust = wheels()
    drive(trust, 50, 0.0, 0.5, 0.5, step_ns=1000 * MS)
    assert trust.is_trusted


def test_walls_that_do_not_say_are_no_judge() -> None:
    trust = wheels()
    for k in range(50):
        trust.learn(k * STEP_NS, (k + 1) * STEP_NS, (0.0, 0.0), (0.05, 0.0), (0.05, 0.0), (0.5, 0.0003))
    assert trust.is_trusted
