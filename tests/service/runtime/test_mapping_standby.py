"""A mapping loop that goes on where another was lost."""

from service.mapper.mapping_session import MappingSession
from service.mapper.methods.shared import NoGraph
from service.runtime.mapper_messages import Decisions, Go, Mapped, PassedOver, ResultApplied, Tiles
from service.runtime.mapping import MappingLoop
from tests.service.runtime.mapping_runs import FRAMES, FakeMapper, GraphAtWork, Run, scan


class TestStandBy:
    """A loop that goes on where another was lost."""

    def follow(self, go: Go, graph: NoGraph | None = None) -> tuple[FakeMapper, list[object]]:
        """It takes the items of FRAMES and one scan more, each of which has waited for a second."""
        first = Run(FakeMapper()).put(*FRAMES, scan(70, 90, [1.0, 2.0]))
        mapper, sent = FakeMapper(graph=graph), []
        loop = MappingLoop(MappingSession(lambda: mapper, ["front"], None), sent.append, (), lambda: 10**9)
        loop.go_on(go)
        for item in first.link.items:
            assert loop.is_up_to_date == (loop.number >= go.done_number)
            loop.take(item)
            loop.keep_up(is_idle=True)
        return mapper, sent

    def test_what_is_done_is_done_again_in_silence_and_then_the_clock_decides_again(self):
        mapper, sent = self.follow(Go(2, Decisions({}, frozenset(), frozenset())))
        assert [frame.sensor for frame in mapper.eaten] == ["base", "front"]
        assert mapper.skipped == 2  # both have waited for a second
        assert [s.number for s in sent if isinstance(s, PassedOver)] == [3, 4]
        assert not any(isinstance(s, Mapped) for s in sent)

    def test_what_was_decided_by_the_clock_is_not_decided_again(self):
        decided = Decisions({3: 1}, frozenset([2]), frozenset([4]))
        mapper, sent = self.follow(Go(4, decided), GraphAtWork())
        assert [getattr(e, "sensor", e) for e in mapper.eaten] == ["base", "apply_result", "front"]
        assert mapper.skipped == 1
        assert not any(isinstance(s, PassedOver | ResultApplied | Mapped) for s in sent)

    def test_tiles_are_handed_over_when_it_is_where_the_other_was(self):
        _, sent = self.follow(Go(3, Decisions({}, frozenset(), frozenset())))
        (tiles,) = [s for s in sent if isinstance(s, Tiles)]
        assert tiles.tiles[0].version == 2
