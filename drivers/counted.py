"""A count with its noun."""


def counted(count: int, noun: str, plural: str = "") -> str:
    """1 scan, 0 scans, 2 scans. plural: of the noun, where that is not the noun with an s."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
