"""Words around figures."""


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """ "1 scan", "2 scans"; plural where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
