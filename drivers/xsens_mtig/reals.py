"""The four number formats of Xsens devices: bytes <-> floats. No unit is changed here.

Fixed 16.32 has an order of its own: the 32 bits of the fraction first, then the signed 16 bits of the integer
part. Source: MT0101P, table of precisions.
"""

import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import cache

from drivers.counted import counted
from drivers.errors import ProtocolError

Reals = tuple[float, ...]


class Precision(IntEnum):
    """Number format, the two lowest bits of an MTData2 id and bits 9-8 of the OutputSettings."""

    FLOAT32 = 0
    FP1220 = 1
    FP1632 = 2
    FLOAT64 = 3


BYTES = (4, 4, 6, 8)
_CODES = ("f", "i", "Ih", "d")
_FP1220, _FP1632 = 2.0**20, 2.0**32


@cache
def _layout(precision: int, count: int) -> struct.Struct:
    return struct.Struct(">" + _CODES[precision] * count)


def read_reals(data: bytes, precision: int, count: int, offset: int = 0) -> Reals:
    """`count` numbers from `offset` on. Raises ProtocolError where the bytes end before."""
    try:
        values = _layout(precision, count).unpack_from(data, offset)
    except struct.error as error:
        raise ProtocolError(
            f"{counted(len(data) - offset, 'byte')} where {counted(count, 'number')} of "
            f"{BYTES[precision]} were due"
        ) from error
    if precision == Precision.FP1220:
        return tuple([value / _FP1220 for value in values])
    if precision == Precision.FP1632:
        return tuple([values[i + 1] + values[i] / _FP1632 for i in range(0, 2 * count, 2)])
    return values


def write_reals(values: Sequence[float], precision: int) -> bytes:
    """Raises ValueError where a number does not fit the format."""
    try:
        if precision == Precision.FP1220:
            return _layout(precision, len(values)).pack(*[round(value * _FP1220) for value in values])
        if precision == Precision.FP1632:
            raw = [round(value * _FP1632) for value in values]
            halves = [half for value in raw for half in (value & 0xFFFF_FFFF, value >> 32)]
            return _layout(precision, len(values)).pack(*halves)
        return _layout(precision, len(values)).pack(*values)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{list(values)} do not fit the format {Precision(precision).name}") from error
