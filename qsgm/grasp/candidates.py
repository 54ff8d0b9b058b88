"""Places in a heatmap where the object may be, best first."""

import numpy as np
from numpy.typing import NDArray

# Cells around a candidate that cannot be another one: objects are further apart than 16 px.
_REACH_CELLS = 1


def candidate_cells(quality: NDArray[np.float32], count: int) -> list[tuple[int, int]]:
    """Rows and columns of up to `count` cells of (rows, cols), by quality.

    Each is the best that is left once those before it have taken their neighbours away
    (non-maximum suppression).
    """
    left = quality.astype(np.float64)
    cells = []
    for _ in range(min(count, left.size)):
        row, col = divmod(int(left.argmax()), left.shape[1])
        if left[row, col] == -np.inf:
            break
        cells.append((row, col))
        rows = slice(max(row - _REACH_CELLS, 0), row + _REACH_CELLS + 1)
        left[rows, max(col - _REACH_CELLS, 0) : col + _REACH_CELLS + 1] = -np.inf
    return cells
