"""Sorting and selection: numba's np.argsort takes 2 s to compile, its np.partition 10 s."""

import numpy as np

from service.kernels.compiled import inner_kernel


@inner_kernel
def order_rising(values, order):
    """Stable argsort in rising order.

    values   (N,) float64   no NaN
    order    (N,) int64     out
    Source: merge sort from the bottom up.
    """
    count = values.shape[0]
    merged = np.empty(count, np.int64)
    for i in range(count):
        order[i] = i
    width = 1
    while width < count:
        for low in range(0, count, 2 * width):
            middle = min(low + width, count)
            high = min(low + 2 * width, count)
            left = low
            right = middle
            for i in range(low, high):
                if right >= high or (left < middle and values[order[left]] <= values[order[right]]):
                    merged[i] = order[left]
                    left += 1
                else:
                    merged[i] = order[right]
                    right += 1
        for i in range(count):
            order[i] = merged[i]
        width *= 2


@inner_kernel
def kth_smallest(values, count, k):
    """The k-th smallest, from 0, of the first `count` values.

    values   (M,) float64   no NaN; count of them in use; reordered
    Source: Hoare 1961, Algorithm 65: find.
    """
    low = 0
    high = count - 1
    while low < high:
        pivot = values[k]
        left = low
        right = high
        while left <= right:
            while values[left] < pivot:
                left += 1
            while pivot < values[right]:
                right -= 1
            if left <= right:
                values[left], values[right] = values[right], values[left]
                left += 1
                right -= 1
        if right < k:
            low = left
        if k < left:
            high = right
    return values[k]
