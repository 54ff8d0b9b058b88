"""What exporting found out: as JSON, as a table, and as the bundle's model card."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType

from qsgm.fidelity import LayerFidelity
from qsgm.files import sha256
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, constants
from qsgm.tables import TIGHT, legend, table
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.quantization.calibrate import EQUAL_COSINE, Calibration
from qsgm.train.quantization.lessons import Lessons
from qsgm.tune.report import fidelity_json

# (line break: in a terminal only)
_HEADERS = (
    "\nlayer",
    "\nrange",
    "\nscale",
    "cos\nint8,float",
    "cos\nint8,true",
    "norm\nratio",
    "SQNR\n[dB]",
    "bytes\nint8/float",
)
LEGEND = (
    "range, scale: of the activation channels; cos: cosine of int8, float and true gradients; "
    "norm ratio: |int8|/|true|; bytes: of the SGM's constants"
)
GROUP_LEGEND = (
    "MAC: of a step over backpropagation's, counted; peak: activations alive at once in a step of "
    "32 samples; alone: each layer with its own SGM; bp: backpropagation. Devices tune these, or "
    "what `--blocks` says, which `fold-and-quantize --blocks` exports"
)


@dataclass(frozen=True)
class LayerReport:
    """One SGM: how faithful its int8 version is, mean over the calibration runs, and its size."""

    fidelity: LayerFidelity
    ranges: SgmRanges
    sgm: FoldedSgm
    int8_sgm: QuantizedSgm

    @property
    def float_bytes(self) -> int:
        """Bytes of the float SGM's constants."""
        return sum(conv.weight.nbytes + conv.bias.nbytes for conv in self.sgm.convs)

    @property
    def int8_bytes(self) -> int:
        """Bytes of the int8 SGM's constants, scales included."""
        return sum(array.nbytes for array in constants(self.int8_sgm).values())

    @property
    def activation_range(self) -> tuple[float, float]:
        """Lowest and highest activation of any channel."""
        labels = self.sgm.labels
        low, high = (ends[:-labels] for ends in (self.ranges.input_low, self.ranges.input_high))
        return float(low.min()), float(high.max())

    @property
    def activation_scale(self) -> tuple[float, float]:
        """What one u8 step stands for in the finest and in the coarsest activation channel."""
        step = 1 / self.int8_sgm.input_gain[: -self.sgm.labels]
        return float(step.min()), float(step.max())

    def to_json(self) -> dict[str, Any]:
        """The fidelity keys, then ranges, scales, silent channels and bytes."""
        return {
            **fidelity_json(self.fidelity),
            "range": {
                "activation": _short(*self.activation_range),
                "hidden": _short(*(float(high.max()) for high in self.ranges.hidden_high)),
            },
            "scale": _short(*self.activation_scale),
            "dead_channels": {
                "input": list(self.int8_sgm.dead_inputs),
                "hidden": [list(dead) for dead in self.int8_sgm.dead_hidden],
            },
            "bytes": {"float": self.float_bytes, "int8": self.int8_bytes},
        }

    def cells(self) -> tuple[str, ...]:
        """What a table shows of it."""
        low, high = self.activation_range
        fine, coarse = self.activation_scale
        return (
            str(self.sgm.layer),
            f"{low:.2g}..{high:.2g}",
            f"{fine:.1g}..{coarse:.1g}",
            f"{self.fidelity.cos_int8_float:.5f}",
            f"{self.fidelity.cos_int8_true:.3f}",
            f"{self.fidelity.norm_ratio_int8_true:.2f}",
            f"{self.fidelity.sqnr_db:.1f}",
            f"{self.int8_bytes}/{self.float_bytes}",
        )


@dataclass(frozen=True)
class GroupRow:
    """Layers in the groups in which SGMs pay, in float; peaks are bytes of activations."""

    blocks: str
    macs: float  # of a step over backpropagation's
    macs_alone: float  # if each layer had its SGM
    peak: int
    peak_alone: int
    peak_backprop: int

    def cells(self) -> tuple[str, ...]:
        """What a table shows of it."""
        peaks = (f"{one / 1000:,.1f}" for one in (self.peak, self.peak_alone, self.peak_backprop))
        return (self.blocks, f"{self.macs:.2f}", f"{self.macs_alone:.2f}", *peaks)


@dataclass(frozen=True)
class ExportReport:
    """What :func:`qsgm.train.export.export_bundle` did."""

    output: str
    layers: dict[int, LayerReport]
    calibration: Calibration
    fold_max_abs_error: float
    bundle_bytes: int
    groups: tuple[GroupRow, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The stable keys of `qsgm fold-and-quantize`, then the others."""
        layers = self.layers.values()
        return {
            "output": self.output,
            "calibrator": {str(k): self.calibration.chosen[k] for k in self.layers},
            "calibrators": {
                str(k): {name: round(value, 7) for name, value in cosines.items()}
                for k, cosines in self.calibration.cosines.items()
            },
            "held_out_frames": self.calibration.held_out,
            "layers": {str(k): layer.to_json() for k, layer in self.layers.items()},
            "fold_max_abs_error": _short(self.fold_max_abs_error)[0],
            "bytes": {
                "float": sum(layer.float_bytes for layer in layers),
                "int8": sum(layer.int8_bytes for layer in layers),
            },
            "bundle_bytes": self.bundle_bytes,
            "groups": [asdict(row) for row in self.groups],
        }

    def __rich__(self) -> RenderableType:
        title = f"{self.output}: int8 SGMs, mean over the calibration runs"
        cells = [layer.cells() for layer in self.layers.values()]
        layers = table(title, _HEADERS, cells, left=(), padding=TIGHT)
        groups = (group_table(self.groups), legend(GROUP_LEGEND)) if self.groups else ()
        return Group(layers, legend(LEGEND + "\n"), calibrators(self.calibration), *groups)


def calibrators(calibration: Calibration) -> RenderableType:
    """Whose ranges each SGM has, and why."""
    why = legend(ranges_from(calibration))
    if not judged(calibration):
        return why
    title = "cos int8,float of each calibrator's ranges"
    rows = calibrator_rows(calibration)
    return Group(table(title, calibrator_headers(calibration), rows, left=()), why)


def group_table(rows: Sequence[GroupRow]) -> RenderableType:
    """What devices tune as is usual, and what it costs."""
    headers = ("\nlayers", "MAC\nx bp", "\nalone", "peak\n[kB]", "\nalone", "\nbp")
    return table("groups of layers in which SGMs pay", headers, [row.cells() for row in rows])


def judged(calibration: Calibration) -> bool:
    """Whether calibrators were compared at all."""
    return any(calibration.cosines.values())


def ranges_from(calibration: Calibration) -> str:
    """In one sentence, whose ranges the SGMs have."""
    if not judged(calibration):
        return f"ranges: {', '.join(sorted(set(calibration.chosen.values())))}, as asked"
    frames = "the calibration frames themselves, too few to hold any out"
    if calibration.held_out:
        frames = f"held-out frames, {calibration.held_out} in number"
    return (
        f"ranges: from the calibrator with the highest mean cos int8,float on {frames}; within "
        f"{EQUAL_COSINE:g} of it, from the first"
    )


def calibrator_headers(calibration: Calibration) -> list[str]:
    """Headers of the columns of :func:`calibrator_rows`."""
    return ["layer", *next(iter(calibration.cosines.values())), "taken"]


def calibrator_rows(calibration: Calibration) -> list[list[str]]:
    """By layer: each calibrator's cosine, and which was taken."""
    return [
        [str(layer), *(f"{value:.6f}" for value in cosines.values()), calibration.chosen[layer]]
        for layer, cosines in calibration.cosines.items()
    ]


def markdown(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [headers, ["--:"] * len(headers), *rows])


def model_card(
    report: ExportReport,
    path: Path,
    checkpoint: Checkpoint,
    lessons: Lessons,
    task_files: Iterable[str],
) -> str:
    """The bundle's README.md.

    Args:
        report: on its export.
        path: of the checkpoint that it was made from.
        checkpoint: what that holds.
        lessons: the calibration set.
        task_files: names of what the task adds to a bundle.
    """
    headers = [" ".join(header.split()) for header in _HEADERS]
    lines = markdown(headers, [one.cells() for one in report.layers.values()])
    calibration = report.calibration
    whose = f"R{ranges_from(calibration)[1:]}."
    if judged(calibration):
        rows = calibrator_rows(calibration)
        whose += f"\n\n{markdown(calibrator_headers(calibration), rows)}"
    card = json.dumps(checkpoint.card, indent=1, sort_keys=True)
    depth, task = checkpoint.task.network.depth, checkpoint.task.name
    added = "".join(f"\n| `{name}` | what the task needs beside them |" for name in task_files)
    bits = {layer.int8_sgm.bits for layer in report.layers.values()}
    planes = "one plane" if bits == {8} else "two planes"
    return f"""# Int8 synthetic gradient modules for the task `{task}`

Standard ONNX graphs for fine-tuning the last of {depth} layers on the device, feed-forward;
`manifest.json` says what is in them. Batchnorm is folded into the convolutions (largest change of
any output: {report.fold_max_abs_error:.1e}), normalisation of inputs into those of the trunks.

| file | what |
| --- | --- |
| `network.onnx` | an input to what the network gives |
| `weights.bin` | constants of all other graphs, which open with it beside them only |
| `trunk_P_N.onnx` | inputs to u8 features when the last N layers are tuned, the others in P |
| `head_N.onnx` | features to outputs |
| `step_int8_*_B.onnx`, `step_float_*_B.onnx` | a training step; B: layers in blocks |
| `step_float_*_A-{depth}.onnx` | one block: the same step by backpropagation, for comparison |
| `probe_N.onnx` | int8, float and true gradients of a batch, and the updates they lead to |{added}

## Made from

    qsgm fold-and-quantize {path.name}

- checkpoint: sha256 `{sha256(path.read_bytes())}`
- calibration set: {len(lessons)} lessons, sha256
  `{lessons.sha256}`

How the checkpoint was pretrained, and what it scored:

```json
{card}
```

## The int8 SGMs

u8 activations of {planes}, s8 weights of two planes, a scale for every channel, int32 sums, float
gradients out. Measured on the calibration set while the int8 SGMs fine-tuned the last layers, which
they were meta-trained on; SGMs of layers further in front on batches along shorter runs of all.
{LEGEND[0].upper()}{LEGEND[1:]}.

{lines}

{whose}
"""


def _short(*values: float) -> list[float]:
    """Six significant digits."""
    return [float(f"{np.float64(value):.6g}") for value in values]
