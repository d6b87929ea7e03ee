"""Connected components."""

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]


def groups_of(count: int, pairs: Ints) -> Ints:
    """(count,) lowest index of the connected component of each index below `count`, by pairs (P, 2)."""
    group = np.arange(count)
    first, second = pairs.reshape(-1, 2).T
    while (apart := group[first] != group[second]).any():
        one, other = group[first[apart]], group[second[apart]]
        np.minimum.at(group, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(group, lower := group[group]):
            group = lower
    return group
