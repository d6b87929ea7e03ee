"""For tests: messages damaged as lines damage them."""

import random
from typing import Any


def mutate(wire: bytes, chance: random.Random) -> bytes:
    """One to three times: a bit turned, a byte replaced, a run lost, the rest lost, or bytes put in."""
    damaged = bytearray(wire)
    for _ in range(chance.randrange(1, 4)):
        at = chance.randrange(len(damaged) + 1)
        match chance.randrange(5):
            case 0 if at < len(damaged):
                damaged[at] ^= 1 << chance.randrange(8)
            case 1 if at < len(damaged):
                damaged[at] = chance.randrange(256)
            case 2:
                del damaged[at : at + chance.randrange(1, 31)]
            case 3:
                del damaged[at:]
            case _:
                damaged[at:at] = chance.randbytes(chance.randrange(1, 9))
    return bytes(damaged)


def buffered(decoder: Any) -> int:
    """Bytes that a decoder keeps until the rest of a message comes."""
    return len(decoder._buffer)
