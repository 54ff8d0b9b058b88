"""The one public error type, and how a name becomes text that can be shown."""

_LONGEST_MESSAGE = 6000  # room for a path as long as systems allow


class QsgmError(Exception):
    """What the user gave cannot be used.

    The message is one line that says what was got, what was expected and what to do;
    the command line prints it and exits with 1.
    """

    def __init__(self, message: str) -> None:
        super().__init__(as_text(message, _LONGEST_MESSAGE))


def as_text(name: str, most: int = 200) -> str:
    """A name as it can be shown: on one line, without control characters, not without end.

    What cannot be printed is escaped, as is a byte that is not UTF-8; of a long name the middle is
    left out.
    """
    if len(name) > most:
        name = f"{name[: most // 2]}...{name[-most // 2 :]}"
    if name.isprintable():
        return name
    return "".join(
        sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in name
    )
