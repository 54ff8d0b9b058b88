"""`qsgm pretrain`: from nothing to `sgm.pt`, in six stages, resumable.

1. backbone: GraspNet learns drawn objects by backpropagation.
2. matching: the SGMs behind layers 4 and 5 regress true gradients.
3. meta: MAML with these SGMs as the update rule, three layers tuned.
4. early: the SGMs behind layers 1 to 3 regress true gradients.
5. rates: where the device's decaying rates start, the best of a few on drawn objects of their own.
6. decision: how the evidence for and against a candidate is weighed, on whole drawn scenes.

What is done so far is kept beside the output as `<output>.partial` and taken up again by the same
version's same command: output, seed and device.
"""

import json
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from errno import EACCES
from pathlib import Path
from typing import Any

import torch
from torch import nn

import qsgm
from qsgm.blocks import single_layers
from qsgm.errors import QsgmError
from qsgm.files import write_text_atomic
from qsgm.grasp.decision import Decision
from qsgm.train.checkpoint import Checkpoint, save_checkpoint
from qsgm.train.grasp.decision import DecisionConfig, fit_decision
from qsgm.train.grasp.decision_scenes import DecisionScenesConfig, judged_scenes
from qsgm.train.model.graspnet import LAYERS, GraspNet, Loss
from qsgm.train.model.sgm import Sgm
from qsgm.train.model.start import folded_start, write_back
from qsgm.train.pretraining.backbone import BackboneConfig, BackboneTraining, in_memory_format
from qsgm.train.pretraining.evaluate import Score, UpdateRule
from qsgm.train.pretraining.maml import MamlConfig, MetaTraining, OuterFigures
from qsgm.train.pretraining.map_sgms import EarlyConfig, EarlyMatching
from qsgm.train.pretraining.matching import MatchingConfig, fit_sgm, record_examples
from qsgm.train.pretraining.rates import (
    EARLY_RATE_GRID,
    SHORT_GAINS,
    RatesConfig,
    block_rates,
    choose_early,
    choose_late,
    choose_short_gain,
    late_candidates,
)
from qsgm.train.pretraining.resume import Partial
from qsgm.train.pretraining.tasks import TaskSet, draw_tasks

TUNED = 3
# Where meta-training's own rates start: layer 4 learns, the layers behind it hold still enough
# for its SGM to know what they do.
FIRST_RATES = (6e-3, 1e-3, 3e-3)
SAVE_EVERY = 100

# stage, steps done, steps in all, figures worth showing
Watch = Callable[[str, int, int, dict[str, float]], None]


@dataclass(frozen=True)
class PretrainConfig:
    """Sizes of all stages; the defaults make the shipped checkpoint."""

    hidden: tuple[int, ...] = (64, 64)
    tasks: int = 400
    crops_per_task: int = 400
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    maml: MamlConfig = field(default_factory=MamlConfig)
    early: EarlyConfig = field(default_factory=EarlyConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)
    scenes: DecisionScenesConfig = field(default_factory=DecisionScenesConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)


def pretrain(
    output: Path,
    seed: int,
    device: str,
    watch: Watch,
    config: PretrainConfig | None = None,
    loss: Loss | None = None,
) -> Checkpoint:
    """Pretrain and write `output`.

    Args:
        output: `sgm.pt`; its model card goes beside it, `sgm.md`. Folders on the way are made.
        seed: of everything drawn at random.
        device: `cpu` or `cuda`, for the backbone; the rest is small and stays on the CPU.
        watch: told about progress.
        config: sizes; the default makes the shipped checkpoint.
        loss: and with it the angle encoding.

    Raises:
        QsgmError: the device is not there, `output` cannot be written, or training diverged:
            weights are not finite, or fine-tuning fails at every rate. Then no `output` is written.
    """
    config, loss = config or PretrainConfig(), loss or Loss()
    _check_device(device)
    _check_output(output)
    partial = Partial.open(output, _identity(seed, device, config, loss))
    net = _backbone(partial, config, loss, seed, device, watch)
    with one_thread():
        rule = _learn_to_tune(partial, net, config, loss, seed, watch)
        early = _match_early(partial, net, rule, config, seed, watch)
        rule = replace(rule, sgms={**early, **rule.sgms})
        rates, gain, score = _choose_rates(net, rule, config, seed, watch)
        rule = replace(rule, rates=rates[str(single_layers(TUNED))])
        decision = _decide(net, rule, config, seed, watch)
    command = _command(seed, device, config, loss)
    card = _card(command, device, config, score, partial)
    checkpoint = Checkpoint(net, rule.sgms, rule.curvatures, loss, rates, card, gain, decision)
    save_checkpoint(output, checkpoint)
    write_text_atomic(output.with_suffix(".md"), _card_text(output, card))
    partial.remove()
    return checkpoint


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: thousands of tiny operations only wait for a second one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _identity(seed: int, device: str, config: PretrainConfig, loss: Loss) -> dict[str, Any]:
    """What must be the same for an unfinished pretraining to be taken up."""
    return {
        "qsgm": qsgm.__version__,
        "seed": seed,
        "device": device,
        "config": repr(config),
        "loss": repr(loss),
    }


def _learn_to_tune(
    partial: Partial, net: GraspNet, config: PretrainConfig, loss: Loss, seed: int, watch: Watch
) -> UpdateRule:
    """Stages 2 and 3: what tunes the last three layers; `net` gets its new start."""
    tasks = _draw(net, config.tasks, config.crops_per_task, seed + 1, loss, watch)
    sgms = _match(partial, net, tasks, config, loss, seed, watch)
    return _meta_train(partial, net, sgms, tasks, config, loss, seed, watch)


def _backbone(
    partial: Partial, config: PretrainConfig, loss: Loss, seed: int, device: str, watch: Watch
) -> GraspNet:
    training = BackboneTraining(config.backbone, loss, seed, device)
    if "net" in partial.data:
        training.net.load_state_dict(partial.data["net"])
        return _portable(training.net)
    if "backbone" in partial.data:
        training.resume(partial.data["backbone"])
    mean = 0.0

    def after_step(step: int, value: float) -> None:
        nonlocal mean
        mean = value if mean == 0.0 else 0.98 * mean + 0.02 * value
        watch("backbone", step, config.backbone.steps, {"loss": mean})
        if step % SAVE_EVERY == 0:
            _refuse_unless_finite("backbone", training.net)
            partial.save(backbone=training.state())

    net = _portable(training.run(after_step))
    _refuse_unless_finite("backbone", net)
    partial.save(backbone=None, net=net.state_dict())
    return net


def _portable(net: GraspNet) -> GraspNet:
    """On the CPU, in the usual layout, in eval mode."""
    return in_memory_format(net.cpu(), torch.contiguous_format).eval()


def _draw(
    net: GraspNet,
    count: int,
    crops: int,
    seed: int,
    loss: Loss,
    watch: Watch,
    last_frozen: int = LAYERS - TUNED,
) -> TaskSet:
    done = 0

    def after_task() -> None:
        nonlocal done
        done += 1
        watch("tasks", done, count, {})

    return draw_tasks(net, count, crops, seed, loss, after_task, last_frozen)


def _match(
    partial: Partial,
    net: GraspNet,
    tasks: TaskSet,
    config: PretrainConfig,
    loss: Loss,
    seed: int,
    watch: Watch,
) -> dict[int, Sgm]:
    torch.manual_seed(seed + 3)
    sgms = {layer: Sgm(layer, config.hidden) for layer in range(LAYERS + 1 - TUNED, LAYERS)}
    if "sgms" in partial.data:
        for layer, sgm in sgms.items():
            sgm.load_state_dict(partial.data["sgms"][layer])
        return {layer: sgm.eval() for layer, sgm in sgms.items()}
    # Layers 5 and 6 hold still here: what layer 4's SGM regresses is then a function of its input.
    rates = (FIRST_RATES[0], 0.0, 0.0)
    start = folded_start(net, TUNED)
    examples = record_examples(tasks, start, rates, loss, config.matching, seed)
    done, total = 0, len(sgms) * config.matching.fit_steps

    def after_step() -> None:
        nonlocal done
        done += 1
        watch("matching", done, total, {})

    for layer, sgm in sgms.items():
        fit_sgm(sgm, examples[layer], config.matching, seed + layer, after_step)
    _refuse_unless_finite("matching", *sgms.values())
    partial.save(sgms={layer: sgm.state_dict() for layer, sgm in sgms.items()})
    return sgms


def _meta_train(
    partial: Partial,
    net: GraspNet,
    sgms: dict[int, Sgm],
    tasks: TaskSet,
    config: PretrainConfig,
    loss: Loss,
    seed: int,
    watch: Watch,
) -> UpdateRule:
    start = folded_start(net, TUNED)
    training = MetaTraining(config.maml, loss, tasks, start, sgms, FIRST_RATES, seed)
    if "meta" in partial.data:
        training.resume(partial.data["meta"])
    mean: dict[str, float] = {}

    def after_step(step: int, figures: OuterFigures) -> None:
        now = {"query": figures.query_loss}
        now |= {f"cos{layer}": value for layer, value in figures.cosine.items()}
        for name, value in now.items():
            if value == value:
                mean[name] = 0.98 * mean.get(name, value) + 0.02 * value
        watch("meta", step, config.maml.outer_steps, dict(mean))
        if step % SAVE_EVERY == 0:
            _refuse_unless_finite("meta", *sgms.values())
            partial.save(meta=training.state())

    training.run(after_step)
    write_back(net, [(weight.detach(), bias.detach()) for weight, bias in training.start])
    _refuse_unless_finite("meta", net, *sgms.values())
    rates = tuple(float(rate) for rate in training.log_rates.detach().exp())
    return UpdateRule(sgms, training.learnt_curvatures(), rates, loss)


def _match_early(
    partial: Partial,
    net: GraspNet,
    rule: UpdateRule,
    config: PretrainConfig,
    seed: int,
    watch: Watch,
) -> dict[int, Sgm]:
    early = config.early
    pixels = _draw(net, early.tasks, early.crops_per_task, seed + 4, rule.loss, watch, 0)
    training = EarlyMatching(early, rule, folded_start(net, LAYERS), pixels, seed + 5)
    if "early" in partial.data:
        for layer, sgm in training.sgms.items():
            sgm.load_state_dict(partial.data["early"][layer])
        return {layer: sgm.eval() for layer, sgm in training.sgms.items()}
    done = 0

    def after_step(cosines: dict[int, float]) -> None:
        nonlocal done
        done += 1
        watch("early", done, early.steps, {f"cos{layer}": c for layer, c in cosines.items()})

    sgms = training.run(after_step)
    _refuse_unless_finite("early", *sgms.values())
    partial.save(early={layer: sgm.state_dict() for layer, sgm in sgms.items()})
    return sgms


def _choose_rates(
    net: GraspNet, rule: UpdateRule, config: PretrainConfig, seed: int, watch: Watch
) -> tuple[dict[str, tuple[float, ...]], float, Score]:
    """Rates for all numbers of layers and blocks, short runs' gain, and the score of three."""
    sizes = config.rates
    tasks = _draw(net, sizes.tasks, sizes.crops_per_task, seed + 2, rule.loss, watch)
    done = 0
    total = len([*late_candidates(rule.rates)]) + len(SHORT_GAINS)
    total += (LAYERS - TUNED) * len(EARLY_RATE_GRID)

    def after_run(score: Score) -> None:
        nonlocal done
        done += 1
        watch("rates", done, total, {"angle": score.angle_mae_deg})

    start = folded_start(net, TUNED)
    rates, score = choose_late(rule, start, tasks, sizes, after_run)
    pixels = _draw(
        net, sizes.early_tasks, sizes.early_crops_per_task, seed + 6, rule.loss, watch, 0
    )
    rule = replace(rule, rates=rates[TUNED])
    gain = choose_short_gain(rule, start, tasks, sizes, after_run)
    rates |= choose_early(rule, folded_start(net, LAYERS), pixels, sizes, after_run)
    singles = {str(single_layers(tuned)): of_layers for tuned, of_layers in rates.items()}
    return singles | block_rates(rates[TUNED]), gain, score


def _decide(
    net: GraspNet, rule: UpdateRule, config: PretrainConfig, seed: int, watch: Watch
) -> Decision:
    done = 0

    def after_episode() -> None:
        nonlocal done
        done += 1
        watch("decision", done, config.scenes.episodes, {})

    start = folded_start(net, TUNED)
    judged = judged_scenes(net, rule, start, config.scenes, seed + 7, after_episode)
    return fit_decision(judged, config.decision, seed)


def _check_device(device: str) -> None:
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


def _command(seed: int, device: str, config: PretrainConfig, loss: Loss) -> str:
    """What to type for the same checkpoint; options at their defaults are left out."""
    hidden = ",".join(map(str, config.hidden))
    options = {
        "--device": (device, "cpu"),
        "--encoding": (loss.encoding, Loss().encoding),
        "--hidden": (hidden, ",".join(map(str, PretrainConfig().hidden))),
    }
    said = [f" {name} {value}" for name, (value, usual) in options.items() if value != usual]
    return f"qsgm pretrain -o sgm.pt --seed {seed}{''.join(said)}"


def _card(
    command: str, device: str, config: PretrainConfig, score: Score, partial: Partial
) -> dict[str, Any]:
    return {
        "command": command,
        "qsgm": qsgm.__version__,
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} thread(s)",
        "device": device,
        "seconds": round(partial.seconds),
        "resumed": partial.resumed,
        "config": asdict(config),
        "drawn_objects": {name: round(value, 4) for name, value in asdict(score).items()},
    }


def _card_text(output: Path, card: dict[str, Any]) -> str:
    figures = "\n".join(f"- {name}: {value}" for name, value in card["drawn_objects"].items())
    resumed = ", interrupted and resumed" if card["resumed"] else ""
    return f"""# {output.name}

GraspNet and the static SGMs behind its layers 1 to 5, batchnorm not yet folded. Made by

    {card["command"]}

in {card["seconds"]} s{resumed} (backbone on {card["device"]}; {card["machine"]},
torch {card["torch"]}, qsgm {card["qsgm"]}), on drawn objects alone: no photograph was seen. Objects
drawn anew, tuned by these SGMs in float, three layers:

{figures}

All settings:

```json
{json.dumps(card["config"], indent=1)}
```
"""
