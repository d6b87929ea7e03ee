"""Mapper's processes that misbehave. The environment selects their fault."""

HOW = "CORRIDOR_TEST_MAPPER"
LOADED = "CORRIDOR_TEST_LOADED"  # a file, in which "says what it loads" puts a line for each time
FATAL_RANGE_M = 6.66  # of the first beam of a scan that a mapper dies of
