import pytest
import zenoh.ext as ze

from service.publishing.attachment import Attachment, make_gid


def test_the_bytes_are_those_that_zenoh_serialises_for_rmw():
    gid = bytes(range(16))
    expected = ze.z_serialize((ze.Int64(-7), ze.Int64(1_700_000_000_123_456_789), gid)).to_bytes()
    attachment = Attachment(-7, 1_700_000_000_123_456_789, gid)
    assert attachment.encode() == expected
    assert len(expected) == 33
    assert Attachment.decode(expected) == attachment


@pytest.mark.parametrize("content", [b"", bytes(32), bytes(33), bytes(34)])
def test_other_bytes_are_refused(content):
    with pytest.raises(ValueError, match="expected 33 with a gid of 16"):
        Attachment.decode(content)


def test_a_gid_is_stable_in_a_run_and_differs_by_channel_and_run():
    gids = [make_gid("a", "pose"), make_gid("a", "map"), make_gid("b", "pose")]
    assert len(set(gids)) == 3
    assert {len(gid) for gid in gids} == {16}
    assert make_gid("a", "pose") == gids[0]
