"""One probable mistake in an input, in words."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Implausibility:
    """Something that can be read but is probably not what the person means. ``str`` gives the text of a warning."""

    kind: str
    """What kind of mistake it is, in fixed lower-case words, such as ``"range unit"`` or ``"room unit"``."""
    what: str
    """What was found, with the numbers that show it."""
    cause: str
    """The most likely cause."""
    remedy: str
    """What to do."""

    def __str__(self) -> str:
        """One line: what; cause; remedy."""
        return f"{self.what}; {self.cause}; {self.remedy}"
