"""When the place of a session in a stored map is proven, and when it is revoked."""

from service.mapper.graph.loops.stored_graph import MAX_CONTRADICTIONS, MIN_APART_M, Placement


def found(path_length_m: float = 10.0) -> Placement:
    placement = Placement(is_in_stored=True)
    placement.found(path_length_m)
    return placement


def test_a_place_is_unproven_until_a_second_viewpoint():
    placement = found()
    assert placement.state == "unproven"
    placement.seen(10.0 + 0.9 * MIN_APART_M, agrees=True)
    assert placement.state == "unproven"
    placement.seen(10.0 + MIN_APART_M, agrees=True)
    assert placement.state == "proven"


def test_consecutive_contradictions_revoke_a_place():
    placement = found()
    for _ in range(MAX_CONTRADICTIONS - 1):
        assert not placement.seen(12.0, agrees=False)
    placement.seen(12.0, agrees=True)  # people nearby, for example
    for _ in range(MAX_CONTRADICTIONS - 1):
        assert not placement.seen(13.0, agrees=False)
    assert placement.seen(14.0, agrees=False)
    assert placement.state == "unknown"
    placement.found(15.0)
    assert placement.state == "unproven"
    assert not placement.seen(16.0, agrees=False)  # counted again


def test_a_proven_place_stays_proven():
    placement = found()
    placement.seen(20.0, agrees=True)
    for _ in range(5):
        assert not placement.seen(30.0, agrees=False)
    assert placement.state == "proven"
