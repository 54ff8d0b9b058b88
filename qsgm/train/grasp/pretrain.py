"""`qsgm pretrain`: the grasping task from nothing to `sgm.pt`.

The five stages of :mod:`qsgm.train.pretraining.pretrain`, and a sixth, on whole drawn scenes: how
all evidence for and against a candidate is weighed.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from qsgm.grasp.comparer import Comparer
from qsgm.grasp.task import GraspTask
from qsgm.progress import Progress, counted
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.grasp.comparer import digest, shipped_comparer
from qsgm.train.grasp.decision import DecisionConfig, fit_decision
from qsgm.train.grasp.decision_scenes import DecisionScenesConfig, judged_scenes
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.model.fold import folded_start
from qsgm.train.pretraining.pretrain import Learnt, PretrainConfig, pretrain


@dataclass(frozen=True)
class DecisionStage:
    """The sixth stage."""

    task: GraspTask
    comparer: Comparer = field(default_factory=shipped_comparer)
    scenes: DecisionScenesConfig = field(default_factory=DecisionScenesConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)

    def to_json(self) -> dict[str, Any]:
        return {name: asdict(getattr(self, name)) for name in ("scenes", "decision")} | {
            "comparer": digest(self.comparer)
        }

    def __call__(self, learnt: Learnt, seed: int, watch: Progress) -> GraspTask:
        start = folded_start(learnt.net, len(learnt.rule.rates))
        count = counted(watch, "decision", self.scenes.episodes)
        judged = judged_scenes(
            learnt.net, learnt.rule, start, self.comparer, self.scenes, seed + 7, count
        )
        decision = fit_decision(judged, self.decision, seed, self.comparer)
        return replace(self.task, decision=decision)


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
