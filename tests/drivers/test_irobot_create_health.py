"""What the health line of a Create 2 or a Roomba says of its encoders."""

import pytest

from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import encode_frame
from tests.drivers.irobot_bench import MS, STANDING, bench


@pytest.mark.parametrize(
    ("faulty", "words"),
    [((43,), "left encoder jumps"), ((44,), "right encoder jumps"), ((43, 44), "both encoders jump")],
)
def test_faulty_encoder_is_in_the_status_while_it_jumps_and_in_the_log_every_ten_seconds(
    faulty: tuple[int, ...], words: str, caplog: pytest.LogCaptureFixture
):
    table = bench(STANDING)
    table.run(1.0)

    def take(jumps: bool, frames: int) -> None:
        for number in range(frames):
            table.now_ns += 15 * MS
            counts = {43: 0, 44: 0, 22: 14_000} | dict.fromkeys(faulty, 20_000 * (jumps and number % 2))
            table.session.receive_data(encode_frame(STREAM_IDS, counts), table.now_ns)

    take(True, 1600)  # 24 s
    assert table.session.status.startswith(f"streaming; {words}; battery")
    assert table.session.counters["encoder_faults"] == 800
    lines = [record.getMessage() for record in caplog.records]
    assert [line.partition("not counted")[2] for line in lines] == [
        "", "; 334 jumps since the last such line", "; 334 jumps since the last such line",
    ]  # fmt: skip
    take(False, 660)  # 9.9 s
    assert words in table.session.status
    take(False, 10)
    assert table.session.status.startswith("streaming; battery")
