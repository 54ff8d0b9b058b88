"""Direct feedback alignment (Nøkland, 2016).

The error at the outputs, projected by a fixed random matrix of its own to every hidden layer. It
needs no weight behind a layer, but the whole forward pass before the first update.
"""

from collections.abc import Mapping

from torch import Tensor

from qsgm.train.paper.baselines.interface import ForwardPass
from qsgm.train.paper.baselines.projections import project


class DirectFeedbackAlignment:
    """Output errors (T, B, 3) times `projections` (3, P, C) by layer."""

    def __init__(self, projections: Mapping[int, Tensor]) -> None:
        self.projections = projections

    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        del weights  # that they are not needed is the point
        return project(batch.output_error[:, :, 0], self.projections, batch.hidden())
