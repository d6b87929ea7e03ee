"""How clearly a pose of the known map exceeds all other places of a search, by the beams."""

import math

from service.geometry.poses import Floats
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.graph.relocalise.place_search import find_places, is_same_place


def evidence_margin(search: DetachedSearch, pose_map: Floats) -> float:
    """Nats by which the evidence of a pose (3,) in the map exceeds every other place of the newest query;
    inf if there is none, nan before the first search. At the true pose a value below 0 means an ambiguous
    query.
    """
    seen, known_map = search._query, search._known_map
    if seen is None or known_map is None:
        return math.nan
    here = known_map.refine(seen, known_map.align(seen, pose_map)).score.evidence
    others = [one for one in find_places(known_map, seen) if not is_same_place(one.fit.pose, pose_map)]
    return here - max((one.score.evidence for one in others), default=-math.inf)
