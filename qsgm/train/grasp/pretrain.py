"""`qsgm pretrain`: the grasping task from nothing to `sgm.pt`.

The five stages of :mod:`qsgm.train.pretraining.pretrain`, and a sixth, on whole drawn scenes: a
network that compares a candidate with the taught object, and how all evidence for and against it is
weighed.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from qsgm.grasp.comparer import Comparer
from qsgm.grasp.task import GraspTask
from qsgm.progress import Progress, counted
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.grasp.comparer import ComparerConfig, draw_examples, train_comparer
from qsgm.train.grasp.decision import DecisionConfig, fit_decision
from qsgm.train.grasp.decision_scenes import DecisionScenesConfig, heatmap_of, judged_scenes
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.model.fold import folded_start
from qsgm.train.pretraining.pretrain import Learnt, PretrainConfig, pretrain
from qsgm.train.pretraining.tasks import start_states

Start = Sequence[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class DecisionStage:
    """The sixth stage."""

    task: GraspTask
    comparer: ComparerConfig = field(default_factory=ComparerConfig)
    scenes: DecisionScenesConfig = field(default_factory=DecisionScenesConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)

    def to_json(self) -> dict[str, Any]:
        return {name: asdict(getattr(self, name)) for name in ("comparer", "scenes", "decision")}

    def __call__(self, learnt: Learnt, seed: int, watch: Progress) -> GraspTask:
        start = folded_start(learnt.net, len(learnt.rule.rates))
        comparer = self._comparer(learnt, start, seed + 11, watch)
        count = counted(watch, "decision", self.scenes.episodes)
        judged = judged_scenes(
            learnt.net, learnt.rule, start, comparer, self.scenes, seed + 7, count
        )
        return replace(self.task, decision=fit_decision(judged, self.decision, seed, comparer))

    def _comparer(self, learnt: Learnt, start: Start, seed: int, watch: Progress) -> Comparer:
        states = start_states(start, 1)
        look = partial(heatmap_of, learnt.net, states, heads=self.task.heads)
        count = counted(watch, "examples", self.comparer.episodes)
        examples = draw_examples(look, self.comparer, seed, count)
        return train_comparer(examples, self.comparer, seed, watch)


def pretrain_grasping(
    task: DrawnGrasping,
    output: Path,
    seed: int,
    device: str,
    watch: Progress,
    config: PretrainConfig | None = None,
    last_stage: DecisionStage | None = None,
) -> Checkpoint:
    """Pretrain and write `output`; arguments and errors as :func:`pretrain` has them."""
    stage = last_stage or DecisionStage(task)
    usual = task.encoding == DrawnGrasping().encoding
    arguments = "" if usual else f" --encoding {task.encoding}"
    return pretrain(task, output, seed, device, watch, config, stage, arguments)
