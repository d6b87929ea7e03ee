"""What is done of a site in parallel: where a session lies in it, and the loops between two sessions."""

from dataclasses import dataclass, replace
from pathlib import Path

from service.mapper.graph.edit.merging import MergeError, find_second, together
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.loops.loop_batches import Batch
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.saved_graph import SavedGraph
from service.mapstore.graph_files import read_graph, write_graph
from service.offline.cluster.tasks import Done

ENOUGH = 4  # places of a session that say the same of where it lies
EVERY_M = 2.0  # along the path a loop to each other session, as often as the mapper looks within one


@dataclass(frozen=True, slots=True)
class _OfTwo:
    """first, second   folders that keep_graph wrote"""

    name: str
    first: Path
    second: Path
    program: str

    def graphs(self) -> tuple[SavedGraph, int]:
        """Both in one, and how many key frames the first has. Raises InputError."""
        first, second = (
            read_graph(folder, [path.name for path in folder.iterdir()])
            for folder in (self.first, self.second)
        )
        return together(first, second), len(first)


class Find(_OfTwo):
    """Where the second lies in the first: outcome `pose_first_second` [x m, y m, theta rad], or `why` it is
    not found.
    """

    def work(self) -> Done:
        try:
            pose, _ = find_second(*self.graphs(), LoopsConfig(), ENOUGH)
        except MergeError as error:
            return Done({"why": str(error)}, {})
        return Done({"pose_first_second": pose.tolist()}, {})


class FindLoops(_OfTwo):
    """Loops from the first to the second, accepted as in the mapper: outcome `loops`, their key frames
    counted in either graph. The second lies about where it is in the map frame of the first: 1.5 m, 0.2 rad.
    """

    def work(self) -> Done:
        both, count = self.graphs()
        back_end = LoopBackEnd(LoopsConfig(search_every_m=EVERY_M), None, both)
        back_end.begin_session_at(count, is_across=True)
        back_end.work(Batch([], is_last=True))
        across = [loop for loop in back_end.loops if loop.of < count <= loop.to]
        return Done({"loops": [replace(loop, to=loop.to - count) for loop in across]}, {})


def keep_graph(graph: SavedGraph, folder: Path) -> Path:
    """Write a graph to a new folder, for tasks. Raises OSError."""
    folder.mkdir()
    write_graph(folder, graph, None)
    return folder
