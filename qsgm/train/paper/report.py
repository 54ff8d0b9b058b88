"""The tables of `qsgm bench paper`, next to the paper's own, and the same as JSON."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.images import write_png
from qsgm.tables import CLOSE, legend, number, table
from qsgm.train.paper.experiment import PaperConfig, PaperResults
from qsgm.train.paper.objects import OBJECTS, contact_sheet
from qsgm.train.paper.published import TABLE_1, TABLE_2, Published, PublishedSystem
from qsgm.train.paper.systems import ADAM, BATCHNORM, WITH_BATCHNORM, sgd_variant

METRICS = {"detection": 1, "angle": 2}  # and where it stands in a score
_FORMS = {"detection": "{:.2f}", "angle": "{:.1f}"}
_TITLES = {"detection": "share of crops detected rightly", "angle": "angle error [deg]"}
DIVERGED = "–"
# A network that knows nothing is at about 1.5; one beyond this has blown up.
LOST = 4.0
NOT_RUN = ""
# Our name for what the paper's Table 2 calls a system.
_SYSTEM_OF = {"trained, static": "SGM, 2 layers"}
# System of the third table -> what the paper says of it in words.
OTHERS: Mapping[str, str] = {
    "BP, 3 layers": "best of BP",
    "BP by SGD": "",
    "BP, SGMs' start": "",
    "BP, 4 layers": "as 3 layers",
    "SGM, 3 layers": "best of SGM",
    "SGM, 4 layers": "below 3",
    "SGM, random": "fails",
    "SGM, no label": "no angle",
    "SGM, trained by l1": "below l2",
    "feedback alignment": "",
    "direct feedback": "",
    "target projection": "",
}
# How its settings differ from the paper's.
NOTES: tuple[str, ...] = (
    "The objects are drawn, not photographed, and a network that has seen five of them has seen "
    "five tables and one light each.",
    "The paper does not say how long it trains: here 1000 steps for the network, 3000 for the SGMs "
    "and 30 epochs of fine-tuning. Nor does it say whether the pool takes the maximum or, as here, "
    "the mean.",
    "The paper names a momentum of 0.9 for pretraining; of fine-tuning it says the rate alone. "
    "Static SGMs on batchnorm converge without momentum, and with it blow up in the end.",
    "A step at 0.1 is one through batchnorm in the paper. On folded weights, which is what a "
    "device has, the same rate is another step, and mostly one too far.",
    "The paper's encoding of the angle jumps at 90 degrees, for every method alike. An angle's "
    "zero is the demonstration as it lies, in every object another direction.",
    "The paper's Table 1 averages over seven objects and shows six: the printed spreads come out "
    "with a seventh, which Table 2 shows as its f, leaving out Table 1's c.",
)


def write_sheet(path: Path, config: PaperConfig) -> None:
    """Write a picture of the objects that take part. Raises QsgmError where it cannot."""
    write_png(path, contact_sheet(tuple(OBJECTS)[: config.objects]))


def best_variant(results: PaperResults, system: str) -> str | None:
    """The SGD rate with the lowest mean objective; None where each diverged on some object."""
    runs = [results.scores[letter][system] for letter in results.letters]
    sound = {
        variant: float(np.mean([run[variant][0] for run in runs]))
        for variant in map(sgd_variant, results.config.rates)
        if all(variant in run and converged(run[variant][0]) for run in runs)
    }
    return min(sound, key=lambda variant: sound[variant]) if sound else None


def converged(objective: float) -> bool:
    """False for a run that blew up, not a number included."""
    return objective < LOST


def values_of(results: PaperResults, system: str, variant: str, metric: str) -> list[float] | None:
    """One metric by object, not a number where the run diverged; None: not run so."""
    runs = [results.scores[letter][system] for letter in results.letters]
    if any(variant not in run for run in runs):
        return None
    scores = [run[variant] for run in runs]
    return [s[METRICS[metric]] if converged(s[0]) else float("nan") for s in scores]


def render(results: PaperResults) -> RenderableType:
    """Both of the paper's tables, the others, and what to keep in mind."""
    names = ", ".join(f"{letter} {OBJECTS[letter].name}" for letter in results.letters)
    parts: list[RenderableType] = [
        Text(f"objects: {names}; each tuned after pretraining on the others")
    ]
    for title, published in (("Table 1", TABLE_1), ("Table 2, two layers", TABLE_2)):
        parts += [_table(results, title, published, metric) for metric in METRICS]
    parts += [_others_table(results), legend(_LEGEND)]
    return Group(*parts, *(Text(f"- {note}") for note in NOTES))


_LEGEND = (
    "SGD 0.1: the paper's rate, constant; below it, or `best`: the rate of those tried with the "
    "lowest mean objective on the same crops; both with momentum 0.9 and on folded weights, as on "
    "the device. BN: batchnorm kept and on batch statistics while tuning, at the paper's rate; "
    "without momentum, as we read the paper, or with 0.9. –: diverged on this object, or on any; "
    "– 2/6: on all but 2 of 6."
)


def _table(
    results: PaperResults, title: str, published: Mapping[str, PublishedSystem], metric: str
) -> Table:
    cells: list[Sequence[object]] = []
    for name, figures in published.items():
        rows = _rows(results, _SYSTEM_OF.get(name, name), metric)
        titles = [name, *[""] * len(rows)]
        cells += [[], *([head, *row] for head, row in zip(titles, rows, strict=False))]
        cells.append(["", legend("paper"), *_paper_cells(results, figures, metric)])
    headings = ["", "", *results.letters, "avg", "std"]
    return _table_of(f"{title}: {_TITLES[metric]}", headings, cells, left=(0, 1))


def _table_of(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[object]], left: Sequence[int]
) -> Table:
    made = table(title, headings, rows, left, CLOSE)
    made.pad_edge = False
    return made


def _rows(results: PaperResults, system: str, metric: str) -> list[list[str]]:
    """How a system was run, and its cells: the paper's rate, the best one, batchnorm kept."""
    first, best = sgd_variant(results.config.rates[0]), best_variant(results, system)
    labels = {ADAM: ADAM, first: first} | ({best: best} if best else {})
    rows = []
    for variant, label in (labels | {name: name for name in WITH_BATCHNORM}).items():
        values = values_of(results, system, variant, metric)
        if values is not None:
            cells = _cells([*values, *_statistics(values)], _FORMS[metric].format)
            rows.append([label, *cells])
    return rows


def _paper_cells(results: PaperResults, figures: PublishedSystem, metric: str) -> list[Text]:
    published: Published = getattr(figures, metric)
    values = [*published.values[: len(results.letters)], published.average, published.spread]
    return [legend(_FORMS[metric].format(value)) for value in values]


def _others_table(results: PaperResults) -> Table:
    rows = []
    for system, said in OTHERS.items():
        best = best_variant(results, system) or ADAM
        variants = (sgd_variant(results.config.rates[0]), best, BATCHNORM)
        cells = [cell for variant in variants for cell in _averages(results, system, variant)]
        rate = best.removeprefix("SGD ") if values_of(results, system, best, "angle") else "none"
        rows.append([system, *cells, rate.replace(ADAM, "Adam"), said])
    pairs = [text for how in ("SGD 0.1", "best", "BN") for text in (f"{how}\ndet.", "\nangle")]
    title = f"three layers, other systems: averages over {len(results.letters)} objects"
    return _table_of(title, ["", *pairs, "best\nrate", "in the\npaper"], rows, left=(0, 8))


def _averages(results: PaperResults, system: str, variant: str) -> list[str]:
    """Detection and angle error, averaged; or on how many objects the run did not diverge."""
    cells = []
    for metric in METRICS:
        values = values_of(results, system, variant, metric)
        if values is None:
            return [NOT_RUN, NOT_RUN]
        sound = int(np.isfinite(values).sum())
        if sound < len(values):
            return [DIVERGED, f"{sound}/{len(values)}"]
        cells.append(_FORMS[metric].format(_statistics(values)[0]))
    return cells


def _cells(values: Sequence[float], form: Callable[[float], str]) -> list[str]:
    return [form(value) if np.isfinite(value) else DIVERGED for value in values]


def _statistics(values: Sequence[float]) -> tuple[float, float]:
    """Average and spread (of all, as the paper has it)."""
    return float(np.mean(values)), float(np.std(values))


def to_json(results: PaperResults) -> dict[str, Any]:
    """Settings, the paper's figures, and every run's scores: null where it diverged."""
    return {
        "seed": results.seed,
        "config": asdict(results.config),
        "objects": {letter: asdict(OBJECTS[letter]) for letter in results.letters},
        "paper": {
            title: {name: asdict(row) for name, row in rows.items()}
            for title, rows in (("table_1", TABLE_1), ("table_2", TABLE_2))
        },
        "systems": {
            system: {
                "best": best_variant(results, system),
                "variants": {
                    variant: _variant_json(results, system, variant) for variant in variants
                },
            }
            for system, variants in results.scores[results.letters[0]].items()
        },
        "notes": list(NOTES),
    }


def _variant_json(results: PaperResults, system: str, variant: str) -> dict[str, Any]:
    """Values by object, and their averages over the objects."""
    found: dict[str, Any] = {}
    for metric in METRICS:
        values = values_of(results, system, variant, metric) or []
        found[metric] = {
            "values": {k: number(v, 4) for k, v in zip(results.letters, values, strict=True)},
            "average": number(_statistics(values)[0], 4),
        }
    return found
