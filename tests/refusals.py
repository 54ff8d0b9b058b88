"""What a refusal is, in Python as on the command line: one error type, one line."""

from collections.abc import Callable
from typing import Any

import pytest

from qsgm import QsgmError


def refusal_of(call: Callable[..., object], *arguments: Any) -> str:
    """The line by which a call with these arguments is refused."""
    with pytest.raises(QsgmError) as raised:
        call(*arguments)
    text = str(raised.value)
    assert text
    assert "\n" not in text
    return text
