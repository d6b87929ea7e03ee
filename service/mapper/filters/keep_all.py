"""No filter."""

from service.mapper.components import Match, Points


def keep_all(points: Points, match: Match) -> Points:
    return points
