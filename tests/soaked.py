"""Tables of cases of which `make test` runs a share, and `make soak` the rest."""

from collections.abc import Iterable
from typing import Any

import pytest


def in_soak(*values: Any) -> Any:
    """A case for `make soak` alone."""
    return pytest.param(*values, marks=pytest.mark.soak)


def every_other(cases: Iterable[tuple[Any, ...]]) -> list[Any]:
    """The first, third and so on as they are, those between in `make soak`.

    Of a product with an odd number of values that change fastest, each value of each kind is among the first.
    """
    return [case if k % 2 == 0 else in_soak(*case) for k, case in enumerate(cases)]
