"""The one public error type."""


class QsgmError(Exception):
    """What the user gave cannot be used.

    The message is one line that says what was got, what was expected and what to do;
    the command line prints it and exits with 1.
    """
