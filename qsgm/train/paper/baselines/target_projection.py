"""Direct random target projection (Frenkel et al., 2019).

The signal of hidden layer k is B_k^T y*, the label y* under a fixed random projection, in the place
of the gradient and with its sign: weights go against it. It needs nothing but the label, and every
layer can learn during the forward pass.

For their one-hot labels y* is the sign of y* - y but for a constant factor and offset, which is why
projecting it can stand for projecting the error. Our label is (quality, sine, cosine). Quality, 0
or 1, is as in their paper: the error of a sigmoid has the label's sign. Of negatives all three are
0, so that the hidden layers learn from positives only. A sine or cosine says nothing about the sign
of the error in a regression, which this baseline is to show. B_k is drawn symmetric about 0: the
sign convention makes no difference on average.
"""

from collections.abc import Mapping

from torch import Tensor

from qsgm.train.paper.baselines.interface import ForwardPass
from qsgm.train.paper.baselines.projections import project


class TargetProjection:
    """Labels (T, B, 3) times `projections` (3, P, C) by layer."""

    def __init__(self, projections: Mapping[int, Tensor]) -> None:
        self.projections = projections

    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        del weights  # that they are not needed is the point
        return project(batch.labels, self.projections, batch.hidden())
