"""How many of a thing, in words."""


def counted(number: int, noun: str) -> str:
    """So many of a thing: "1 frame", "1,000 frames"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
