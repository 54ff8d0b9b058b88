"""Pretraining in its order: from drawn tasks to a checkpoint, resumable.

1. backbone: the network learns drawn examples by backpropagation.
2. matching: the SGMs behind the late layers but the last regress true gradients, along runs of
   backpropagation, then (for tasks of samples) along runs of their own.
3. meta: MAML with these SGMs as the update rule, the late layers tuned.
4. early: the SGMs behind the layers in front of those regress true gradients.
5. rates: where the device's decaying rates start, the best of a few on drawn lessons of their own;
   for tasks of samples also with which optimizer, at every length that a run may have.

A task may add a last stage of its own. What is done so far is kept beside the output as
`<output>.partial` and taken up again by the same version's same command: output, seed and device.
"""

import hashlib
import json
import os
import platform
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from errno import EACCES
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

import qsgm
from qsgm.blocks import Blocks, single_layers
from qsgm.errors import QsgmError
from qsgm.files import write_text_atomic
from qsgm.manifest import Recipe
from qsgm.progress import Progress, counted
from qsgm.task import Described, task_record
from qsgm.train.checkpoint import Checkpoint, save_checkpoint
from qsgm.train.grouping import sgm_cost, usual_blocks
from qsgm.train.model.curvature import FLAT
from qsgm.train.model.fold import convolutions, folded_start, write_back
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.backbone import BackboneConfig, BackboneTraining, in_memory_format
from qsgm.train.pretraining.evaluate import Score, UpdateRule
from qsgm.train.pretraining.first_rates import candidates, choose_first, rate_alone
from qsgm.train.pretraining.maml import MamlConfig, MetaTraining, OuterFigures
from qsgm.train.pretraining.map_sgms import MapConfig, MapMatching
from qsgm.train.pretraining.matching import MatchingConfig, fit_sgm, record_examples
from qsgm.train.pretraining.own_runs import OwnRunsConfig, learn_along_own_runs
from qsgm.train.pretraining.rates import (
    EARLY_RATE_GRID,
    SHORT_GAINS,
    AfterRun,
    RatesConfig,
    Trials,
    block_rates,
    choose_early,
    choose_grouped,
    choose_late,
    choose_short_gain,
    late_candidates,
)
from qsgm.train.pretraining.recipes import choose_recipes, late_runs
from qsgm.train.pretraining.resume import Partial
from qsgm.train.pretraining.tasks import TaskSet, draw_tasks
from qsgm.train.processes import one_thread
from qsgm.train.task import DrawnTask

SAVE_EVERY = 100


@dataclass(frozen=True)
class PretrainConfig:
    """Sizes of all stages; the defaults make the shipped checkpoint."""

    hidden: tuple[int, ...] = (64, 64)
    # Of the late layers, which are meta-trained, where that starts: the first of them learns, those
    # behind it hold still enough for its SGM to know what they do. A number: so many layers, whose
    # rates are tried out.
    first_rates: tuple[float, ...] | int = (6e-3, 1e-3, 3e-3)
    tasks: int = 400
    crops_per_task: int = 400
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    own_runs: OwnRunsConfig = field(default_factory=OwnRunsConfig)
    maml: MamlConfig = field(default_factory=MamlConfig)
    early: MapConfig = field(default_factory=MapConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)
    # Whether rates are found for the groups of layers in which SGMs pay, too.
    grouped: bool = False
    # Whether optimizer and rates are found by a run's length: :func:`choose_recipes`.
    by_length: bool = False

    @property
    def late(self) -> int:
        """How many of the last layers are meta-trained."""
        return self.first_rates if isinstance(self.first_rates, int) else len(self.first_rates)


@dataclass(frozen=True)
class Learnt:
    """What the five stages come to."""

    net: ConvNet
    first_rates: tuple[float, ...]  # where meta-training started
    rule: UpdateRule  # its rates are those of the late layers
    rates: dict[str, tuple[float, ...]]  # by blocks
    late: "LateRates"


@dataclass(frozen=True)
class LateRates:
    """How up to as many layers as were meta-trained are tuned."""

    rates: dict[int, tuple[float, ...]]  # of SGD, by how many they are
    short_gain: float
    recipes: dict[str, tuple[Recipe, ...]]  # by blocks, where they were found by length
    score: Score  # of all of them, tuned


class LastStage(Protocol):
    """What a task learns when its network and SGMs are there."""

    def to_json(self) -> dict[str, Any]:
        """Its sizes, for the card."""
        ...

    def __call__(self, learnt: Learnt, seed: int, watch: Progress) -> Described:
        """The task with what was learnt."""
        ...


def pretrain(
    task: DrawnTask,
    output: Path,
    seed: int,
    device: str,
    watch: Progress,
    config: PretrainConfig | None = None,
    last_stage: LastStage | None = None,
    arguments: str = "",
    trained: ConvNet | None = None,
) -> Checkpoint:
    """Pretrain and write `output`.

    Args:
        task: what the network is for, and where lessons come from.
        output: `sgm.pt`; its model card goes beside it, `sgm.md`. Folders on the way are made.
        seed: of everything drawn at random.
        device: `cpu` or `cuda`, for the backbone; the rest is small and stays on the CPU.
        watch: told about progress.
        config: sizes; the default makes the shipped checkpoint.
        last_stage: of the task's own.
        arguments: that the same command takes for the task, such as ` --encoding paper`.
        trained: a network that is trained already, instead of the first stage.

    Raises:
        QsgmError: the device is not there, `output` cannot be written, or training diverged:
            weights are not finite, or fine-tuning fails at every rate. Then no `output` is written.
    """
    config = config or PretrainConfig()
    check_device(device)
    _check_output(output)
    extra = {} if last_stage is None else last_stage.to_json()
    identity = _identity(task, seed, device, config, extra)
    if trained is not None:
        identity |= {"trained": _digest(trained)}
    partial = Partial.open(output, identity)
    stages = _Stages(task, config, seed, watch, partial)
    # Meta-training gives a network a new start.
    net = stages.backbone(device) if trained is None else _portable(deepcopy(trained))
    with one_thread():
        learnt = stages.learnt(net)
        done = task if last_stage is None else last_stage(learnt, seed, watch)
    command = _command(seed, device, config) + arguments
    config = replace(config, first_rates=learnt.first_rates)
    card = _card(command, device, config, extra, learnt.late.score, partial)
    rule = learnt.rule
    checkpoint = Checkpoint(
        task_record(done),
        net,
        rule.sgms,
        rule.curvatures,
        learnt.rates,
        card,
        learnt.late.short_gain,
        learnt.late.recipes,
    )
    save_checkpoint(output, checkpoint)
    write_text_atomic(output.with_suffix(".md"), _card_text(output, card))
    partial.remove()
    return checkpoint


def _identity(
    task: DrawnTask, seed: int, device: str, config: PretrainConfig, extra: dict[str, Any]
) -> dict[str, Any]:
    """What must be the same for an unfinished pretraining to be taken up."""
    return {
        "qsgm": qsgm.__version__,
        "seed": seed,
        "device": device,
        "config": repr((config, extra)),
        "task": repr(task),
    }


def _digest(net: ConvNet) -> str:
    """Of a network's weights."""
    digest = hashlib.sha256()
    for name, value in net.state_dict().items():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class _Stages:
    """The stages of one pretraining, and what is done so far."""

    task: DrawnTask
    config: PretrainConfig
    seed: int
    watch: Progress
    partial: Partial

    def backbone(self, device: str) -> ConvNet:
        """Stage 1."""
        partial, config = self.partial, self.config.backbone
        training = BackboneTraining(config, self.task, self.seed, device)
        if "net" in partial.data:
            training.net.load_state_dict(partial.data["net"])
            return _portable(training.net)
        if "backbone" in partial.data:
            training.resume(partial.data["backbone"])
        mean = 0.0

        def after_step(step: int, value: float) -> None:
            nonlocal mean
            mean = value if mean == 0.0 else 0.98 * mean + 0.02 * value
            self.watch("backbone", step, config.steps, {"loss": mean})
            if step % SAVE_EVERY == 0:
                _refuse_unless_finite("backbone", training.net)
                partial.save(backbone=training.state())

        net = _portable(training.run(after_step))
        _refuse_unless_finite("backbone", net)
        partial.save(backbone=None, net=net.state_dict())
        return net

    def learnt(self, net: ConvNet) -> Learnt:
        """Stages 2 to 5; `net` gets its new start."""
        config, late = self.config, self.config.late
        tasks = self._drawn(net, config.tasks, config.crops_per_task, 1, late)
        sgms = self._matched(net, tasks)
        first = self._first_rates(net, sgms, tasks)
        self._match_on(net, sgms, tasks, first)
        rule = self._meta_trained(net, sgms, tasks, first)
        rule = replace(rule, sgms={**self._early(net, rule), **rule.sgms})
        rates, found = self._rates(net, rule)
        return Learnt(net, first, replace(rule, rates=found.rates[late]), rates, found)

    def _drawn(self, net: ConvNet, count: int, samples: int, shift: int, tuned: int) -> TaskSet:
        """Tasks as the first of so many tuned layers sees them."""
        after_task, last_frozen = counted(self.watch, "tasks", count), net.network.depth - tuned
        return draw_tasks(
            net, self.task, count, samples, self.seed + shift, after_task, last_frozen
        )

    def _resumed(self, part: str, sgms: Mapping[int, Sgm]) -> bool:
        """Whether SGMs were learnt before an interruption; they are then as they were."""
        saved = self.partial.data.get(part)
        if saved is not None:
            for layer, sgm in sgms.items():
                sgm.load_state_dict(saved[layer])
                sgm.eval()
        return saved is not None

    def _matched(self, net: ConvNet, tasks: TaskSet) -> dict[int, Sgm]:
        """Stage 2: SGMs that regress true gradients."""
        config, network, sizes = self.config, self.task.network, self.config.matching
        torch.manual_seed(self.seed + 3)
        layers = network.last(config.late)
        sgms = {layer: Sgm(network, layer, config.hidden) for layer in layers[:-1]}
        if self._resumed("sgms", sgms):
            return sgms
        start = folded_start(net, len(layers))
        if isinstance(config.first_rates, int):
            rate = rate_alone(tasks, start, self.task, sizes, self.seed) if sgms else 0.0
        else:
            rate = config.first_rates[0]
        # All but the first hold still here: what its SGM regresses is then a function of its input.
        rates = (rate, *[0.0] * len(sgms))
        examples = record_examples(tasks, start, rates, self.task, sizes, self.seed)
        after_step = counted(self.watch, "matching", len(sgms) * sizes.fit_steps)
        for layer, sgm in sgms.items():
            fit_sgm(sgm, examples[layer], sizes, self.seed + layer, after_step)
        _refuse_unless_finite("matching", *sgms.values())
        self.partial.save(sgms=_copied(sgms))
        return sgms

    def _first_rates(self, net: ConvNet, sgms: dict[int, Sgm], tasks: TaskSet) -> tuple[float, ...]:
        """Where meta-training starts."""
        config = self.config
        if isinstance(config.first_rates, tuple):
            return config.first_rates
        after_run = _scored(counted(self.watch, "first rates", len([*candidates(config.late)])))
        rule, start = UpdateRule(sgms, FLAT, (), self.task), folded_start(net, config.late)
        return choose_first(Trials(rule, start, tasks, after_run), config.rates)

    def _match_on(
        self, net: ConvNet, sgms: dict[int, Sgm], tasks: TaskSet, rates: tuple[float, ...]
    ) -> None:
        """Teach the SGMs, in place, along runs that they drive."""
        sizes = self.config.own_runs
        if not sizes.rounds or self._resumed("own", sgms):
            return
        after_step = counted(self.watch, "own runs", len(sgms) * sizes.rounds * sizes.fit.fit_steps)
        start = folded_start(net, self.config.late)
        learn_along_own_runs(sgms, start, tasks, rates, self.task, sizes, self.seed + 7, after_step)
        _refuse_unless_finite("own runs", *sgms.values())
        self.partial.save(own=_copied(sgms))

    def _meta_trained(
        self, net: ConvNet, sgms: dict[int, Sgm], tasks: TaskSet, rates: tuple[float, ...]
    ) -> UpdateRule:
        """Stage 3; SGMs and `net` are changed in place."""
        config, partial = self.config.maml, self.partial
        start = folded_start(net, len(rates))
        training = MetaTraining(config, self.task, tasks, start, sgms, rates, self.seed)
        if "meta" in partial.data:
            training.resume(partial.data["meta"])
        mean: dict[str, float] = {}

        def after_step(step: int, figures: OuterFigures) -> None:
            now = {"query": figures.query_loss}
            now |= {f"cos{layer}": value for layer, value in figures.cosine.items()}
            for name, value in now.items():
                if value == value:
                    mean[name] = 0.98 * mean.get(name, value) + 0.02 * value
            self.watch("meta", step, config.outer_steps, dict(mean))
            if step % SAVE_EVERY == 0:
                _refuse_unless_finite("meta", *sgms.values())
                partial.save(meta=training.state())

        training.run(after_step)
        write_back(net, [(weight.detach(), bias.detach()) for weight, bias in training.start])
        _refuse_unless_finite("meta", net, *sgms.values())
        learnt = tuple(float(rate) for rate in training.log_rates.detach().exp())
        return UpdateRule(sgms, training.learnt_curvatures(), learnt, self.task)

    def _early(self, net: ConvNet, rule: UpdateRule) -> dict[int, Sgm]:
        """Stage 4: the SGMs in front of the meta-trained layers."""
        early, depth = self.config.early, self.task.network.depth
        if len(rule.rates) == depth:
            return {}
        pixels = self._drawn(net, early.tasks, early.crops_per_task, 4, depth)
        training = MapMatching(early, rule, folded_start(net, depth), pixels, self.seed + 5)
        if self._resumed("early", training.sgms):
            return training.sgms
        tell = counted(self.watch, "early", early.steps)

        def after_step(cosines: dict[int, float]) -> None:
            tell({f"cos{layer}": cosine for layer, cosine in cosines.items()})

        sgms = training.run(after_step)
        _refuse_unless_finite("early", *sgms.values())
        self.partial.save(early={layer: sgm.state_dict() for layer, sgm in sgms.items()})
        return sgms

    def _rates(
        self, net: ConvNet, rule: UpdateRule
    ) -> tuple[dict[str, tuple[float, ...]], LateRates]:
        """Rates of SGD for all numbers of layers and blocks, and how the late layers are tuned."""
        sizes, network, late = self.config.rates, self.task.network, len(rule.rates)
        tasks = self._drawn(net, sizes.tasks, sizes.crops_per_task, 2, late)
        groups = _groups(rule, late) if self.config.grouped else []
        total = (
            late_runs(rule.rates)
            if self.config.by_length
            else len([*late_candidates(rule.rates)]) + len(SHORT_GAINS)
        )
        total += (network.depth - late + len(groups)) * len(EARLY_RATE_GRID)
        after_run = _scored(counted(self.watch, "rates", total))
        found = _late_rates(Trials(rule, folded_start(net, late), tasks, after_run), self.config)
        rates, rule = dict(found.rates), replace(rule, rates=found.rates[late])
        grouped = {} if self.config.grouped else block_rates(network, rates[late])
        if late < network.depth:
            count, samples = sizes.early_tasks, sizes.early_crops_per_task
            pixels = self._drawn(net, count, samples, 6, network.depth)
            whole = folded_start(net, network.depth)
            early = Trials(rule, whole, pixels, after_run)
            rates |= choose_early(early, sizes)
            grouped |= choose_grouped(early, sizes, groups)
        singles = {str(single_layers(network.last(k))): one for k, one in rates.items()}
        return singles | grouped, found


def _portable(net: ConvNet) -> ConvNet:
    """On the CPU, in the usual layout, in eval mode."""
    return in_memory_format(net.cpu(), torch.contiguous_format).eval()


def _copied(sgms: dict[int, Sgm]) -> dict[int, dict[str, Tensor]]:
    """Their state as it is now: later stages change them in place."""
    return {
        layer: {name: value.clone() for name, value in sgm.state_dict().items()}
        for layer, sgm in sgms.items()
    }


def _scored(tell: Callable[..., None]) -> AfterRun:
    """Tells what comes of every run."""
    return lambda score: tell({"objective": score.objective})


def _late_rates(trials: Trials, config: PretrainConfig) -> LateRates:
    """Rates of the layers that were meta-trained, and of fewer."""
    rule, network = trials.rule, trials.rule.task.network
    if not config.by_length:
        rates, score = choose_late(trials, config.rates)
        trials = replace(trials, rule=replace(rule, rates=rates[len(trials.start)]))
        return LateRates(rates, choose_short_gain(trials, config.rates), {}, score)
    recipes, score = choose_recipes(trials)
    rates = {
        tuned: next(one.rates for one in some if one.optimizer == "sgd")
        for tuned, some in recipes.items()
    }
    named = {str(single_layers(network.last(tuned))): some for tuned, some in recipes.items()}
    return LateRates(rates, 1.0, named, score)


def _groups(rule: UpdateRule, late: int) -> list[Blocks]:
    """Groups of more layers than were meta-trained in which SGMs pay."""
    network = rule.task.network
    costs = {
        k: sgm_cost(network, k, [(*conv.weight.shape,) for conv in convolutions(sgm)])
        for k, sgm in rule.sgms.items()
    }
    usual = usual_blocks(network, network.depth, costs, late)
    return [
        blocks
        for tuned, blocks in usual.items()
        if tuned > late and blocks != single_layers(blocks.layers)
    ]


def check_device(device: str) -> None:
    """Refuse a device that is not there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise QsgmError("--device cuda: torch sees no CUDA device here; use --device cpu")


def _check_output(output: Path) -> None:
    """Find out before the training whether its result can be written; makes the folders."""
    if output.suffix.lower() == ".md":
        raise QsgmError(f"-o {output}: that is where the model card goes; pass a name like sgm.pt")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        if output.is_dir():
            raise QsgmError(f"-o {output}: expected a file, got a folder; pass a name like sgm.pt")
        for path in (output, output.with_suffix(".md")):
            if path.exists() and not path.is_file():
                raise QsgmError(f"cannot write {path}: it is there and no file; pass another name")
        if not os.access(output.parent, os.W_OK | os.X_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise QsgmError(f"cannot write {output}: {reason}; pass another place") from error


def _refuse_unless_finite(stage: str, *modules: nn.Module) -> None:
    for module in modules:
        if not all(torch.isfinite(value).all() for value in module.state_dict().values()):
            raise QsgmError(
                f"pretraining diverged in stage `{stage}`: {type(module).__name__} has weights that"
                " are not finite; pass another --seed, or lower the rates in PretrainConfig"
            )


def _command(seed: int, device: str, config: PretrainConfig) -> str:
    """What to type for the same checkpoint; options at their defaults are left out."""
    hidden = ",".join(map(str, config.hidden))
    options = {
        "--device": (device, "cpu"),
        "--hidden": (hidden, ",".join(map(str, PretrainConfig().hidden))),
    }
    said = [f" {name} {value}" for name, (value, usual) in options.items() if value != usual]
    return f"qsgm pretrain -o sgm.pt --seed {seed}{''.join(said)}"


def _card(
    command: str,
    device: str,
    config: PretrainConfig,
    extra: dict[str, Any],
    score: Score,
    partial: Partial,
) -> dict[str, Any]:
    figures = {"objective": score.objective, **score.scores}
    return {
        "command": command,
        "qsgm": qsgm.__version__,
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} thread(s)",
        "device": device,
        "seconds": round(partial.seconds),
        "resumed": partial.resumed,
        "config": asdict(config) | extra,
        "drawn_objects": {name: round(value, 4) for name, value in figures.items()},
    }


def _card_text(output: Path, card: dict[str, Any]) -> str:
    figures = "\n".join(f"- {name}: {value}" for name, value in card["drawn_objects"].items())
    resumed = ", interrupted and resumed" if card["resumed"] else ""
    return f"""# {output.name}

A network and the static SGMs behind its layers but the last, batchnorm not yet folded. Made by

    {card["command"]}

in {card["seconds"]} s{resumed} (backbone on {card["device"]}; {card["machine"]},
torch {card["torch"]}, qsgm {card["qsgm"]}), on drawn lessons alone: no photograph was seen. Lessons
drawn anew, the late layers tuned by these SGMs in float:

{figures}

All settings:

```json
{json.dumps(card["config"], indent=1)}
```
"""
