"""No filter."""

from service.mapper.stages import Match, Points


def keep_all(points: Points, match: Match) -> Points:
    return points
