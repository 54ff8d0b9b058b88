"""`qsgm teach-comparer`: a comparer, from drawn objects that an untouched network looks for."""

import json
from functools import partial
from pathlib import Path

from qsgm.files import new_file
from qsgm.grasp.task import grasp_task
from qsgm.progress import Progress, counted
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.grasp.comparer import ComparerConfig, train_comparer
from qsgm.train.grasp.comparer_examples import Look, draw_examples
from qsgm.train.grasp.decision_scenes import heatmap_of
from qsgm.train.grasp.episodes import EpisodesConfig
from qsgm.train.model.fold import folded_start
from qsgm.train.pretraining.pretrain import PretrainConfig, check_device
from qsgm.train.pretraining.tasks import start_states
from qsgm.train.processes import in_processes

DRAWN = EpisodesConfig(3799)


def teach_comparer(
    checkpoint_path: Path,
    output: Path,
    seed: int,
    device: str,
    processes: int,
    watch: Progress,
    drawn: EpisodesConfig = DRAWN,
    config: ComparerConfig = ComparerConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Draw examples, learn from them, and write what `shipped_comparer` reads.

    Args:
        checkpoint_path: `sgm.pt`.
        output: a JSON file.
        seed: of everything random.
        device: `cpu` or `cuda`, to learn on.
        processes: that draw, one core each; how many they are changes no example.
        watch: told about progress.
        drawn: how many examples.
        config: the comparer's sizes and rates.

    Raises:
        QsgmError: as :func:`load_checkpoint`, it is another task's checkpoint, the device is not
            there, or `output` cannot be written.
    """
    check_device(device)
    look = _untouched(checkpoint_path)
    with new_file(output) as new:
        count = counted(watch, "examples", drawn.episodes)
        with in_processes(processes) as in_turn:
            examples = draw_examples(look, drawn, seed, count, in_turn)
        comparer = train_comparer(examples, config, seed, device, watch)
        new.write_text(json.dumps(comparer.to_json()) + "\n", encoding="ascii")


def _untouched(checkpoint_path: Path) -> Look:
    checkpoint = load_checkpoint(checkpoint_path)
    task = grasp_task(checkpoint.task, str(checkpoint_path))
    states = start_states(folded_start(checkpoint.net, PretrainConfig().late), 1)
    return partial(heatmap_of, checkpoint.net, states, heads=task.heads)
