"""Plain values, as JSON has them, with something wrong somewhere."""

import copy
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

Way = tuple[Any, ...]

JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.sampled_from([0, 1, -1, 7, 10**400, "", "0", "1.0", "..", "a/b", "a\nb"])
    | st.floats()
    | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


def ways(values: Any, way: Way = ()) -> Iterator[Way]:
    """How to get to everything inside."""
    inner = values.items() if isinstance(values, dict) else ()
    for key, value in enumerate(values) if isinstance(values, list) else inner:
        yield (*way, key)
        yield from ways(value, (*way, key))


def at(values: Any, way: Way) -> Any:
    """What lies there."""
    for key in way:
        values = values[key]
    return values


@st.composite
def damaged(draw: st.DrawFn, values: Any) -> Any:
    """The same values but for one or two, which are gone or something else."""
    broken = copy.deepcopy(values)
    for _ in range(draw(st.integers(1, 2))):
        # Every key is as likely as any other, however much lies below it.
        key = draw(
            st.sampled_from(list(broken) if isinstance(broken, dict) else range(len(broken)))
        )
        *way, last = draw(st.sampled_from([(key,), *ways(broken[key], (key,))]))
        place = at(broken, tuple(way))
        if draw(st.integers(0, 4)) == 0:
            del place[last]
        else:
            place[last] = draw(JUNK | others(values) | near(place[last]))
        if not broken:
            break
    return broken


def others(values: Any) -> st.SearchStrategy[Any]:
    """What belongs elsewhere."""
    return st.sampled_from(list(ways(values))).map(lambda way: copy.deepcopy(at(values, way)))


def near(value: Any) -> st.SearchStrategy[Any]:
    """What might pass for a value."""
    close = [[value], str(value), {"value": value}]
    if isinstance(value, int | float):
        close += [value + 1, value - 1, -value, float(value), 4 * value]
    if isinstance(value, list):
        close += [value[:-1], [*value, *value], value[::-1]]
    return st.sampled_from(close)
