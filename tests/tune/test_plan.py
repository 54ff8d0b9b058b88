"""A plan answers every question once, and contradictions are refused before any work."""

from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from runs import SHORT, Frame

from qsgm import QsgmError, finetune
from qsgm.blocks import parse_blocks
from qsgm.bundle import Bundle
from qsgm.grasp import teach
from qsgm.manifest import OPTIMIZERS, PRECISIONS, FileEntry, Recipe
from qsgm.tune.plan import Plan, peak_activation_bytes, resolve
from qsgm.tune.settings import Settings


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            Settings(precision="int8", layers=6, blocks="1-3,4,5,6"),
            "no step for the blocks 1-3,4,5,6; choose one of",
        ),
        (Settings(precision="int8", blocks="1-4,5,6"), "are the last 6 layers, the settings say 3"),
        (Settings(precision="int8", blocks="4-6"), "leave no place for an SGM: pass --method bp"),
        (
            Settings(precision="int8", blocks="4,5-6", method="bp"),
            "trains all layers as one block, 4-6",
        ),
        (Settings(precision="int8", blocks="4,6"), "gives no blocks of layers"),
    ],
)
def test_blocks_that_cannot_be_trained_are_refused_before_any_work(
    frame: Frame, bundle: Bundle, settings: Settings, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(teach, "crop_source", pytest.fail)
    with pytest.raises(QsgmError, match=said) as raised:
        finetune(frame, bundle, settings)
    assert "\n" not in str(raised.value)


def test_backpropagation_may_be_asked_for_by_its_one_block(frame: Frame, bundle: Bundle) -> None:
    asked = finetune(frame, bundle, Settings(method="bp", blocks="4-6", epochs=1))
    assert asked.network() == finetune(frame, bundle, Settings(method="bp", epochs=1)).network()


def test_more_layers_than_the_bundle_has_are_refused(frame: Frame, bundle: Bundle) -> None:
    small = replace(bundle, manifest=replace(bundle.manifest, most_layers=2))
    with pytest.raises(QsgmError, match="2 layers at most, not 3; pass --layers 2"):
        finetune(frame, small, SHORT)


def test_a_run_says_what_memory_its_steps_take_where_the_bundle_does(bundle: Bundle) -> None:
    assert peak_activation_bytes(bundle, "int8", parse_blocks("4,5,6")) == {
        "sgm": None,
        "backprop": None,
    }
    sizes = {"step_int8_sgd_4,5-6.onnx": 7, "step_float_adam_4-6.onnx": 9, "head_3.onnx": None}
    files = {name: FileEntry("", size) for name, size in sizes.items()}
    told = replace(bundle, manifest=replace(bundle.manifest, files=files))
    found = peak_activation_bytes(told, "int8", parse_blocks("4,5-6"))
    assert found == {"sgm": 7, "backprop": 9}
    assert told.peak_activation_bytes("head_3.onnx") is None


BLOCKS = [None, "6", "5,6", "5-6", "4,5,6", "4-6", "4,5-6", "4-5,6", "1-4,5,6", "1,2,3,4,5,6"]


@given(
    settings=st.builds(
        Settings,
        method=st.sampled_from(["sgm", "bp"]),
        precision=st.sampled_from(PRECISIONS),
        layers=st.integers(-1, 8),
        blocks=st.sampled_from(BLOCKS) | st.text("123456,-", max_size=7),
        trunk=st.sampled_from([None, *PRECISIONS]),
        optimizer=st.sampled_from([None, *OPTIMIZERS]),
    )
)
@example(Settings())
@example(Settings(layers=6, blocks="1-4,5,6", precision="int8", trunk="int8"))
@example(Settings(method="bp", blocks="4-6", optimizer="sgd"))
def test_any_settings_are_refused_in_one_line_or_name_graphs_that_there_are(
    bundle: Bundle, settings: Settings
) -> None:
    plan = plan_or_refusal(settings, bundle)
    if isinstance(plan, str):
        assert "\n" not in plan
        return
    assert plan.layers == range(7 - settings.layers, 7)
    assert settings.blocks in (None, str(plan.blocks))
    assert plan.sgm_blocks == parse_blocks(settings.blocks or str(plan.sgm_blocks))
    assert len(plan.recipe.rates) == settings.layers
    assert settings.optimizer in (None, plan.recipe.optimizer)
    assert plan.precision == ("float" if settings.method == "bp" else settings.precision)
    assert bool(plan.blocks.sgm_layers) == (settings.method == "sgm" and settings.layers > 1)
    for name in (plan.trunk_file, plan.head_file, plan.step_file):
        assert bundle.has(name), name
    assert bundle.has(plan.probe_file) == (settings.layers > 1)


def plan_or_refusal(settings: Settings, bundle: Bundle) -> Plan | str:
    """A plan, or what is said against the settings."""
    try:
        return resolve(settings, bundle)
    except QsgmError as error:
        return str(error)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (Settings(layers=0), "cannot tune the last 0 layers: choose 1 to 6"),
        (Settings(layers=7), "cannot tune the last 7 layers: choose 1 to 6"),
        (Settings(layers=2, blocks="4,5,6"), "are the last 3 layers, the settings say 2"),
        (Settings(blocks="3,4,5"), "gives no blocks of layers: .* to layer 6"),
        (Settings(blocks="5-6", layers=2), "leave no place for an SGM: pass --method bp"),
        (Settings(method="bp", blocks="4,5,6"), "one block, 4-6, not as 4,5,6"),
        (Settings(blocks="4-5,6"), "no step for the blocks 4-5,6; choose one of"),
        (Settings(blocks="4,5-6", optimizer="adam"), "no rates for adam on the blocks 4,5-6"),
    ],
)
def test_settings_that_contradict_each_other_or_the_bundle_are_refused(
    bundle: Bundle, settings: Settings, said: str
) -> None:
    with pytest.raises(QsgmError, match=said) as raised:
        resolve(settings, bundle)
    assert "\n" not in str(raised.value)


def test_what_settings_leave_open_is_the_bundles(bundle: Bundle) -> None:
    plan = resolve(Settings(precision="int8"), bundle)
    assert (plan.trunk, plan.recipe.optimizer, str(plan.blocks)) == ("float", "sgd", "4,5,6")
    assert plan.step_file == "step_int8_sgd_4,5,6.onnx"
    other = replace(bundle, manifest=replace(bundle.manifest, trunk="int8"))
    assert resolve(Settings(), other).trunk_file == "trunk_int8_3.onnx"
    assert resolve(Settings(trunk="float"), other).trunk_file == "trunk_float_3.onnx"
    assert resolve(Settings(layers=6), other).trunk_file == "trunk_float_6.onnx"  # none is frozen


def test_backpropagation_is_in_float_and_compared_with_every_layer_on_its_own(
    bundle: Bundle,
) -> None:
    plan = resolve(Settings(method="bp", precision="int8"), bundle)
    assert (plan.precision, str(plan.blocks), str(plan.sgm_blocks)) == ("float", "4-6", "4,5,6")
    assert plan.step_file == "step_float_adam_4-6.onnx"


def test_a_recipe_of_ones_own_takes_the_place_of_the_bundles(bundle: Bundle) -> None:
    mine = Recipe("adam", (0.1, 0.2, 0.3))
    plan = resolve(Settings(precision="int8"), bundle, mine)
    assert plan.recipe == mine
    assert plan.step_file == "step_int8_adam_4,5,6.onnx"
