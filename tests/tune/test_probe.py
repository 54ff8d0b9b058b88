"""Gradients compared along a run: when, what is told of them, and at no price but time."""

import hashlib
import json
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from rich.console import Console

from qsgm import QsgmError, defaults
from qsgm.bundle import Bundle, load_bundle
from qsgm.fidelity import LayerFidelity
from qsgm.grasp.taught import FinetuneResult
from qsgm.grasp.teach import finetune, prepare_object, train_object, tune_object
from qsgm.manifest import MANIFEST, probe_file
from qsgm.schedule import BATCH, steps_per_epoch
from qsgm.tune import probe as probing
from qsgm.tune.plan import resolve
from qsgm.tune.report import fidelity_command_json, fidelity_command_report
from qsgm.tune.settings import Settings

SHORT = Settings(precision="int8", epochs=2)


@pytest.fixture(scope="module")
def result(frame: NDArray[np.uint8], bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, replace(SHORT, probe_every=20))


def test_probes_are_taken_every_so_many_steps_and_once_an_epoch_by_default(
    result: FinetuneResult, bundle: Bundle
) -> None:
    assert [probe.step for probe in result.probes] == [0, 20, 40]
    assert [probe.epoch for probe in result.probes] == [0, 0.8, 1.6]
    usual = tune_object(result.prepared, resolve(SHORT, bundle))
    assert [probe.step for probe in usual.probes] == [0, 25, 50]
    an_epoch = steps_per_epoch(result.prepared.taught)
    assert defaults.PROBE_EVERY == an_epoch == result.steps / SHORT.epochs == 25
    assert usual.probes[0] == result.probes[0]


def test_probing_changes_nothing_but_what_it_costs(result: FinetuneResult) -> None:
    never = train_object(result.prepared, resolve(SHORT, result.prepared.bundle))
    assert never.network() == result.network()
    assert (never.losses, never.probes) == (result.losses, ())


def test_a_run_without_any_distance_between_probes_is_a_programming_error(
    result: FinetuneResult,
) -> None:
    plan = resolve(replace(SHORT, probe_every=0), result.prepared.bundle)
    with pytest.raises(ValueError, match="`probe_every` must be 1 step or more, got 0"):
        tune_object(result.prepared, plan)


def test_json_has_every_probe_with_its_step_epoch_and_metrics(result: FinetuneResult) -> None:
    values = fidelity_command_json(result, "mug")
    assert values["every"] == 20
    first, second, _ = values["fidelity_over_run"]
    assert (second["step"], second["epoch"]) == (20, 0.8)
    assert set(first) == {"step", "epoch", "4", "5"}
    for layer in (first["4"], values["fidelity"]["5"]):
        assert set(layer) == set(LayerFidelity.__dataclass_fields__)
    probes = [probe["5"]["weighted_error"] for probe in values["fidelity_over_run"]]
    mean = np.mean(probes)
    assert values["fidelity"]["5"]["weighted_error"] == pytest.approx(mean, abs=2e-5)


def test_both_tables_fit_a_terminal_of_80_columns_and_show_every_metric(
    result: FinetuneResult,
) -> None:
    probes = tuple(
        replace(probe, layers=dict.fromkeys(range(1, 6), probe.layers[4]))
        for probe in result.probes
    )
    shown = StringIO()
    five = replace(result, probes=probes)
    Console(file=shown, width=80).print(fidelity_command_report(five))
    lines = shown.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if line.split()[:1] == ["4"]]
    mean = five.fidelity[4]
    assert [len(row) for row in rows] == [8, 8]
    assert rows[0][1:3] == [f"{mean.cos_int8_float:.5f}", f"{mean.cos_int8_true:.3f}"]
    assert rows[1][1:3] == [f"{mean.direction_deviation_deg:.2f}", f"{mean.weighted_error:.4f}"]
    assert rows[1][5:] == [
        f"{mean.cos_update_int8_float:.4f}",
        f"{mean.cos_update_int8_true:.3f}",
        f"{mean.cos_update_float_true:.3f}",
    ]
    assert "probes: 3, at steps 0 to 40 by 20" in lines


def without_output(folder: Path, name: str, output: str) -> Bundle:
    """The bundle with a graph that gives less, as if an earlier version had written it."""
    model = onnx.load(str(folder / name))
    kept = [one for one in model.graph.output if one.name != output]
    assert len(kept) == len(model.graph.output) - 1
    del model.graph.output[:]
    model.graph.output.extend(kept)
    data = model.SerializeToString()
    (folder / name).write_bytes(data)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["files"][name]["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return load_bundle(folder)


def test_a_bundle_whose_probe_gives_less_is_refused_in_one_line(
    frame: NDArray[np.uint8], own_bundle: Path
) -> None:
    old = without_output(own_bundle, probe_file(3), "update_true5")
    with pytest.raises(QsgmError) as caught:
        finetune(frame, old, SHORT)
    said = str(caught.value)
    assert "probe_3.onnx of the bundle" in said
    assert "gives {}, expected {'update_true5': ('tensor(float)', (16, 17))}" in said
    assert "export it again with `qsgm fold-and-quantize`" in said
    assert "\n" not in said
    plan = resolve(replace(SHORT, epochs=0), old)
    assert train_object(prepare_object(frame, old, plan), plan).probes == ()


def test_a_probe_in_pieces_says_what_a_probe_of_the_whole_batch_says(
    frame: NDArray[np.uint8], bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = resolve(Settings(precision="int8", layers=4, epochs=1), bundle)
    prepared = prepare_object(frame, bundle, plan)
    pieces = tune_object(prepared, plan).probes
    monkeypatch.setattr(probing, "PROBE_SLICE", BATCH)
    for piece, whole in zip(pieces, tune_object(prepared, plan).probes, strict=True):
        for layer, expected in whole.layers.items():
            found, wanted = asdict(piece.layers[layer]), asdict(expected)
            # Pieces have different numbers of values other than zero, of which this is a share.
            shares = found.pop("underflow_fraction"), wanted.pop("underflow_fraction")
            assert shares[0] == pytest.approx(shares[1], abs=0.01)
            assert found == pytest.approx(wanted, rel=1e-3, abs=1e-6)
