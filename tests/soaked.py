"""Tables of cases of which `make test` runs a share, and `make soak` the rest."""

from collections.abc import Iterable
from typing import Any

import hypothesis
import pytest

FEW_EXAMPLES, MANY_EXAMPLES = 40, 1000  # that hypothesis tries, in `make test` and in `make soak`


def examples(few: int) -> int:
    """So many where one takes long, and as many times more in `make soak` as of all others."""
    return round(few * hypothesis.settings().max_examples / FEW_EXAMPLES)


def in_soak(*values: Any) -> Any:
    """A case for `make soak` alone."""
    return pytest.param(*values, marks=pytest.mark.soak)


def every_other(cases: Iterable[tuple[Any, ...]]) -> list[Any]:
    """The first, third and so on as they are, those between in `make soak`.

    Of a product with an odd number of values that change fastest, each value of each kind is among the first.
    """
    return [case if k % 2 == 0 else in_soak(*case) for k, case in enumerate(cases)]
