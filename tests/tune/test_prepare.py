"""Features of the frozen layers: the same kept, streamed and in any batch."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from runs import SHORT, Frame, planned, prepared_by, tuned_by

from qsgm import finetune
from qsgm.bundle import Bundle
from qsgm.grasp.crops import CROPS
from qsgm.grasp.taught import FinetuneResult
from qsgm.manifest import Precision
from qsgm.schedule import BATCH
from qsgm.tune.features import StreamedFeatures
from qsgm.tune.settings import Settings


@pytest.fixture(scope="module")
def result(frame: Frame, bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, SHORT)


def test_crops_cut_in_slices_have_the_features_of_crops_cut_at_once(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    crops = planned(frame, bundle).cut(np.arange(60))
    expected = bundle.session("trunk_float_3.onnx").run(None, {"samples": crops})[0]
    assert len(result.prepared.features) == CROPS
    np.testing.assert_allclose(result.prepared.features[:60], expected, atol=1e-5)


def test_the_frozen_layers_run_in_the_precision_asked_for(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    prepared = prepared_by(replace(SHORT, trunk="int8"), frame, bundle)
    crops = planned(frame, bundle).cut(np.arange(20))
    expected = bundle.session("trunk_int8_3.onnx").run(None, {"samples": crops})[0]
    np.testing.assert_array_equal(prepared.features[:20], expected)
    assert not np.array_equal(prepared.features, result.prepared.features)
    trunks = tuned_by(SHORT, prepared).prepared.plan.trunk, result.prepared.plan.trunk
    assert trunks == ("int8", "float")


def assert_same_run(one: FinetuneResult, other: FinetuneResult) -> None:
    """To the last bit."""
    assert one.network() == other.network()
    assert (one.untouched, one.scores) == (other.untouched, other.scores)
    assert (one.losses, one.probes) == (other.losses, other.probes)
    assert one.prepared.orientation.offset_rad == other.prepared.orientation.offset_rad


@pytest.mark.parametrize(
    "settings",
    [
        replace(SHORT, trunk="float"),
        replace(SHORT, trunk="int8"),
        replace(SHORT, method="bp", layers=2),
        replace(SHORT, layers=1, optimizer="adam"),
        replace(SHORT, recalibrate=True),
    ],
)
def test_streamed_features_give_the_same_run_as_kept_ones(
    frame: Frame, bundle: Bundle, settings: Settings
) -> None:
    streamed = finetune(frame, bundle, replace(settings, stream=True))
    assert_same_run(streamed, finetune(frame, bundle, settings))
    seconds = dict(streamed.seconds)
    assert sum(seconds.values()) - seconds["total"] <= seconds["total"]


@pytest.mark.usefixtures("few_crops")
@pytest.mark.parametrize(("layers", "precision"), [(4, "int8"), (5, "float"), (6, "int8")])
def test_streamed_maps_give_the_same_run_as_kept_ones(
    frame: Frame, bundle: Bundle, layers: int, precision: Precision
) -> None:
    settings = Settings(precision=precision, layers=layers, epochs=1)
    streamed = finetune(frame, bundle, replace(settings, stream=True))
    assert_same_run(streamed, finetune(frame, bundle, settings))


@pytest.mark.parametrize("trunk", ["float", "int8"])
@pytest.mark.parametrize("layers", [1, 3])
def test_features_of_a_crop_are_the_same_in_any_batch(
    frame: Frame, bundle: Bundle, trunk: Precision, layers: int
) -> None:
    settings = Settings(precision="int8", layers=layers, trunk=trunk, stream=True)
    source = prepared_by(settings, frame, bundle).source
    rows = np.random.default_rng(0).permutation(CROPS)[:75]
    together = source.of(rows)
    np.testing.assert_array_equal(source.of(rows[40:72]), together[40:72])
    assert source.of(rows[:0]).shape == (0, *together.shape[1:])
    alone = np.concatenate([source.of(rows[i : i + 1]) for i in range(10)])
    np.testing.assert_array_equal(alone, together[:10])


def test_a_streamed_run_never_makes_more_features_than_a_batch(
    frame: Frame, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    plain = StreamedFeatures.of

    def of(self: StreamedFeatures, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        made.append(len(rows))
        return plain(self, rows)

    monkeypatch.setattr(StreamedFeatures, "of", of)
    result = finetune(frame, bundle, replace(SHORT, stream=True, recalibrate=True))
    assert max(made) == BATCH
    kept = {np.size(value) for value in vars(result.prepared.source).values()}
    assert max(kept) < 2 * frame.size
