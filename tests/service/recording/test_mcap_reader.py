import shlex
from collections import Counter

import pytest
from mcap.writer import MCAP0_MAGIC, IndexType, Writer

from service.errors import InputError
from service.recording.mcap_reader import Recording
from service.recording.mcap_recovery import recover
from tests.service.recording.sessions import drive, scan_message, write_file
from tests.service.recording.test_mcap_recovery import chunk_offsets, damage


def test_rotated_files_are_one_recording_whatever_their_order(tmp_path):
    messages = drive(60)
    write_file(tmp_path / "b.mcap", messages[:40])
    write_file(tmp_path / "a.mcap", messages[40:80])
    write_file(tmp_path / "c.mcap", messages[80:])
    recording = Recording([tmp_path / "a.mcap", tmp_path / "c.mcap", tmp_path / "b.mcap"])
    assert [path.name for path in recording.paths] == ["b.mcap", "a.mcap", "c.mcap"]
    read = [(f"{m.channel}", m.type, m.stamp_ns, m.log_ns, m.payload) for m in recording.messages()]
    assert read == [(m.channel, m.type, m.stamp_ns, m.log_ns, m.payload) for m in messages]
    assert {topic.name: topic.count for topic in recording.topics} == {
        "/tf_static": 1,
        "/base/odom": 60,
        "/front/scan": 60,
    }
    assert (recording.first_log_ns, recording.last_log_ns) == (messages[0].log_ns, messages[-1].log_ns)
    assert [m.log_ns for m in Recording([tmp_path]).messages()] == [m.log_ns for m in messages]


def test_files_that_overlap_in_time_are_merged(tmp_path):
    scans = [scan_message(index) for index in range(20)]
    write_file(tmp_path / "even.mcap", scans[::2])
    write_file(tmp_path / "odd.mcap", scans[1::2])
    merged = Recording([tmp_path / "odd.mcap", tmp_path / "even.mcap"]).messages(["/front/scan"])
    assert [m.payload for m in merged] == [m.payload for m in scans]


def test_a_span_of_log_times_is_read_whatever_lies_in_which_file(tmp_path):
    scans = [scan_message(index) for index in range(20)]
    write_file(tmp_path / "a.mcap", scans[:8], sync_every=3)
    write_file(tmp_path / "b.mcap", scans[8:], sync_every=3)
    recording = Recording([tmp_path])
    for first, last in ((0, 19), (3, 3), (5, 11), (8, 19), (0, 7)):
        span = recording.messages(["/front/scan"], scans[first].log_ns, scans[last].log_ns)
        assert [m.log_ns for m in span] == [m.log_ns for m in scans[first : last + 1]]
    assert len(list(recording.messages(None, scans[15].log_ns))) == 5
    assert len(list(recording.messages(None, None, scans[4].log_ns - 1))) == 4
    assert list(recording.messages(None, scans[-1].log_ns + 1)) == []


def test_a_file_without_an_index_is_read_all_the_same(tmp_path):
    path = tmp_path / "bare.mcap"
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start(profile="ros2", library="bare")
        schema = writer.register_schema("sensor_msgs/LaserScan", "ros2msg", b"")
        channel = writer.register_channel("/scan", "cdr", schema)
        for index in (1, 0):
            message = scan_message(index)
            writer.add_message(channel, message.log_ns, message.payload, message.stamp_ns)
        writer.finish()
    recording = Recording([path])
    assert [str(topic) for topic in recording.topics] == ["/scan (sensor_msgs/msg/LaserScan, 2)"]
    assert recording.first_log_ns == scan_message(0).log_ns
    assert [m.log_ns for m in recording.messages()] == [scan_message(i).log_ns for i in (0, 1)]


SUMMARIES = [
    {"repeat_channels": False},
    {"repeat_schemas": False},
    {"repeat_channels": False, "repeat_schemas": False},
    {"use_statistics": False, "repeat_schemas": False},
    {"use_statistics": False, "repeat_channels": False},
    {"index_types": IndexType.NONE},
    {"index_types": IndexType.MESSAGE},
    {"index_types": IndexType.CHUNK, "repeat_channels": False},
    {"use_chunking": False, "repeat_schemas": False},
]


@pytest.mark.parametrize("lacking", SUMMARIES, ids=str)
def test_a_summary_that_lacks_records_costs_nothing(lacking, tmp_path):
    """Nor does `recover` call a file complete that a replay refuses."""
    path, messages = tmp_path / "others.mcap", drive(20)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4000, **lacking)
        writer.start(profile="ros2", library="others")
        writer.add_metadata("config", {"vehicle": "test"})
        channels: dict[str, int] = {}
        for m in messages:
            if m.channel not in channels:
                schema = writer.register_schema(m.type, "ros2msg", b"")
                channels[m.channel] = writer.register_channel(f"/{m.channel}", "cdr", schema)
            writer.add_message(channels[m.channel], m.log_ns, m.payload, m.stamp_ns)
        writer.finish()
    for _ in ("as it was written", "after recover"):
        recording = Recording([path])
        counts = {(topic.name, topic.type): topic.count for topic in recording.topics}
        assert counts == Counter((f"/{m.channel}", m.type) for m in messages)
        assert recording.metadata == {"config": {"vehicle": "test"}}
        read = [(m.channel, m.type, m.log_ns, m.payload) for m in recording.messages()]
        assert read == [(m.channel, m.type, m.log_ns, m.payload) for m in messages]
        span = recording.messages(["/front/scan"], messages[6].log_ns, messages[12].log_ns)
        assert [m.log_ns for m in span] == [m.log_ns for m in messages[6:13:2]]
        recover(path)


def test_recover_mends_a_summary_that_cannot_be_read(tmp_path):
    path = tmp_path / "s_0001.mcap"
    messages = write_file(path, drive(20))
    data = path.read_bytes()
    at = data.rindex(b"/front/scan")  # of the channel, as the summary repeats it
    path.write_bytes(data[: at - 4] + b"\xff\xff\xff\x7f" + data[at:])
    with pytest.raises(InputError, match=r"is damaged: .*; try `corridor recover"):
        Recording([path])
    assert not recover(path).complete
    assert [m.payload for m in Recording([path]).messages()] == [m.payload for m in messages]


def test_an_unfinished_file_is_refused_with_the_command_that_mends_it(tmp_path):
    path = tmp_path / "two words" / "s_0001.mcap"
    path.parent.mkdir()
    write_file(path, drive(60), finish=False)
    with pytest.raises(InputError, match=r"never finished; make it whole with `.*`") as caught:
        Recording([active := path.with_name(path.name + ".active")])
    assert shlex.split(str(caught.value).split("`")[1]) == ["corridor", "recover", str(active)]


def test_what_is_no_mcap_or_not_there_is_refused(tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(b"PK\x03\x04....")
    with pytest.raises(InputError, match="not an MCAP file: it begins with 50 4b"):
        Recording([path])
    path.write_bytes(b"")
    with pytest.raises(InputError, match="begins with nothing"):
        Recording([path])
    with pytest.raises(InputError, match="no such file"):
        Recording([tmp_path / "missing.mcap"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no MCAP files in"):
        Recording([tmp_path / "empty"])


def test_damage_is_met_with_the_command_that_mends_it(tmp_path):
    path = tmp_path / "s_0001.mcap"
    write_file(path, drive(60)[:120])
    damage(path, chunk_offsets(path)[1] + 5_000)
    with pytest.raises(InputError, match=r"is damaged: .*; try `corridor recover"):
        list(Recording([path]).messages())


def test_damage_without_words_of_the_library_is_named_by_its_kind(tmp_path):
    (tmp_path / "a.mcap").write_bytes(MCAP0_MAGIC)
    with pytest.raises(InputError, match=r"a\.mcap is damaged: \w+; try `corridor recover"):
        Recording([tmp_path / "a.mcap"])
