"""SGMs that go on learning while the network is tuned: decoupled neural interfaces.

As in Jaderberg et al. (2017) a layer takes its SGM's gradient, then the SGM takes a step of its own
towards a target by l2. Two targets:

- :func:`true_target`, the ground truth gradient. The paper's (section 4.3, "Static vs. Non-Static
  SGMs"); it needs a whole backward pass.
- :func:`bootstrapped_target`, the next layer's synthetic gradient carried back through the next
  layer, the true one only behind the last SGM. Jaderberg's; no layer waits for more than the next.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy

import torch
from torch import Tensor

from qsgm.schedule import MOMENTUM
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.interface import ForwardPass, carry_back, carry_back_all
from qsgm.train.pretraining.maml import apply_sgm

# (weights, batch, synthetic gradients by layer) -> what they should have been
Target = Callable[[Mapping[int, Tensor], ForwardPass, Mapping[int, Tensor]], Mapping[int, Tensor]]
RATE = 1e-1  # paper section 4.2


def true_target(
    weights: Mapping[int, Tensor], batch: ForwardPass, synthetic: Mapping[int, Tensor]
) -> Mapping[int, Tensor]:
    """The true gradients."""
    del synthetic
    return carry_back_all(weights, batch)


def bootstrapped_target(
    weights: Mapping[int, Tensor], batch: ForwardPass, synthetic: Mapping[int, Tensor]
) -> Mapping[int, Tensor]:
    """Each layer's from the gradient that the next layer itself was given."""
    given = {**synthetic, batch.network.depth: batch.output_error}
    return {
        layer: carry_back(layer + 1, weights[layer + 1], batch, given[layer + 1])
        for layer in synthetic
    }


class OnlineSgms:
    """A copy for each of T tasks of every SGM, learning by SGD with momentum; for one run.

    Args:
        sgms: by layer, what all tasks start from; not changed.
        tasks: T.
        target: what they learn.
        rate: of SGD.
    """

    def __init__(
        self,
        sgms: Mapping[int, Sgm],
        tasks: int,
        target: Target = true_target,
        rate: float = RATE,
    ) -> None:
        self.target = target
        self.sgms: Mapping[int, Sequence[Sgm]] = {
            layer: [deepcopy(sgm).train() for _ in range(tasks)] for layer, sgm in sgms.items()
        }
        parameters = [p for group in self.sgms.values() for sgm in group for p in sgm.parameters()]
        self.optimizer = torch.optim.SGD(parameters, rate, momentum=MOMENTUM)

    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        with torch.enable_grad():
            guess = {
                layer: self._guess(layer, activation, batch.labels)
                for layer, activation in batch.hidden().items()
            }
        synthetic = {layer: gradient.detach() for layer, gradient in guess.items()}
        self._learn(guess, self.target(weights, batch, synthetic))
        return synthetic

    def _guess(self, layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        tasks = zip(self.sgms[layer], activation.split(1), labels.split(1), strict=True)
        return torch.cat([apply_sgm(sgm, x, label) for sgm, x, label in tasks])

    def _learn(self, guess: Mapping[int, Tensor], target: Mapping[int, Tensor]) -> None:
        """One step of every SGM on its own mean squared error."""
        self.optimizer.zero_grad()
        with torch.enable_grad():
            for layer, gradient in guess.items():
                error = (gradient - target[layer]).square().mean(dim=(1, 2, 3))
                error.sum().backward()
        self.optimizer.step()
