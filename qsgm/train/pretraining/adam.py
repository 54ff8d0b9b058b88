"""Adam in torch, as the device runs it, on the layers of many tasks at once."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from qsgm.train.model.local import LayerState


class AdamMoments:
    """Adam as torch has it: number by number, so that no task knows of another."""

    def __init__(self, states: Sequence[LayerState]) -> None:
        self._states = [LayerState.start(one.weight.clone(), one.bias.clone()) for one in states]
        groups = [{"params": [one.weight, one.bias], "lr": 0.0} for one in self._states]
        self._adam = torch.optim.Adam(groups)

    def step(
        self, gradients: Iterable[tuple[Tensor, Tensor]], rates: Sequence[float]
    ) -> list[LayerState]:
        """The states after one more step, which are the same numbers' places every time."""
        groups, found = self._adam.param_groups, [*gradients]
        for state, given, group, rate in zip(self._states, found, groups, rates, strict=True):
            state.weight.grad, state.bias.grad = given
            group["lr"] = rate
        self._adam.step()
        return self._states
