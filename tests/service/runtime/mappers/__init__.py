"""Mapper's processes that misbehave. What they do is said in the environment."""

HOW = "CORRIDOR_TEST_MAPPER"
FATAL_RANGE_M = 6.66  # of the first beam of a scan that a mapper dies of
