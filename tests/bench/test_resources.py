"""What training costs: the paper's Table 3, and counts that torch's own counter gives, too."""

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from qsgm import cli
from qsgm.bench.resources import (
    PUBLISHED,
    Cost,
    as_printed,
    cost_of,
    counted_row,
    int8_bytes,
    measure_resources,
    output_bytes,
    render,
    step_macs,
)
from qsgm.bench.timing import step_job
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.network import GRASPNET
from qsgm.schedule import BATCH
from qsgm.sgm.float import FoldedConv, FoldedSgm, float_trace
from qsgm.sgm.int8 import ActivationBits, SgmRanges, constants, quantize_sgm
from qsgm.train.model.fold import run_folded_sgm
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm


@pytest.fixture(scope="module")
def report(bundle: Bundle) -> dict[str, Any]:
    return measure_resources(bundle, 1, 1, lambda *_: None)


@pytest.fixture(scope="module")
def costs(bundle: Bundle) -> list[Cost]:
    return [cost_of(bundle, number) for number in bundle.network.last(6)]


def products_in(counter: FlopCounterMode) -> int:
    """Multiply-adds that torch counted: it takes each for two operations."""
    return counter.get_total_flops() // 2


def test_the_papers_table_comes_out_of_its_counting_rule(bundle: Bundle) -> None:
    rows = {number: counted_row(bundle.network, number) for number in bundle.network.last(6)}
    assert list(rows) == [*PUBLISHED]
    for layer, printed in PUBLISHED.items():
        assert rows[layer].mac == printed.mac
        assert rows[layer].activations == printed.activations
        assert f"{rows[layer].parameters:.3g}" == f"{printed.parameters:.3g}"
        assert rows[layer].sgm_parameters == pytest.approx(printed.sgm_parameters, abs=4)
    for layer, off in {1: 0.012, 2: 0.009, 3: 1e-4, 4: 0, 5: 0, 6: 0}.items():
        assert rows[layer].sgm_mac == pytest.approx(PUBLISHED[layer].sgm_mac, rel=off)


def test_the_papers_parameters_are_those_of_its_network_and_sgms_in_torch(bundle: Bundle) -> None:
    net = ConvNet(GRASPNET)
    for number in bundle.network.last(6):
        row = counted_row(bundle.network, number)
        layer = net.layers[number - 1]
        assert row.parameters == sum(p.numel() for p in layer.parameters())
        if row.sgm_parameters:
            sgm = Sgm(GRASPNET, number)
            assert row.sgm_parameters == sum(p.numel() for p in sgm.parameters())


@pytest.mark.parametrize(
    ("count", "printed"),
    [(304, 304), (161_216, 161_220), (548_912, 548_910), (2_398_656, 2_400_000), (1000, 1000)],
)
def test_counts_are_rounded_to_two_decimals_of_their_unit(count: int, printed: int) -> None:
    assert as_printed(count) == printed


@pytest.mark.parametrize("tuned", [1, 2, 3, 6])
def test_forward_and_backpropagation_cost_what_torch_counts(costs: list[Cost], tuned: int) -> None:
    net = ConvNet(GRASPNET).eval()
    with torch.no_grad():
        x = net.between(torch.rand(1, 3, 128, 128), 1, 6 - tuned) if tuned < 6 else None
    x = torch.rand(1, 3, 128, 128) if x is None else x
    with FlopCounterMode(display=False) as forward:
        raw = net.between(x, 7 - tuned, 6)
    with FlopCounterMode(display=False) as backward:
        raw.sum().backward()
    step = step_macs(costs[-tuned:])
    assert step["forward"] == BATCH * products_in(forward)
    assert step["backprop"] - step["forward"] == BATCH * products_in(backward)


def test_an_sgm_costs_what_torch_counts_and_int8_one_product_per_plane(
    bundle: Bundle, costs: list[Cost]
) -> None:
    net = ConvNet(GRASPNET).eval()
    for cost in costs[:-1]:
        with torch.no_grad():
            x = net.between(torch.rand(1, 3, 128, 128), 1, cost["layer"])
        sgm = bundle.float_sgm(cost["layer"])
        x = F.pad(x, (0, 0, 0, 0, 0, 3))
        between = 0
        with FlopCounterMode(display=False) as counter:
            for conv in sgm.convs:
                between += x.numel()
                x = F.conv2d(x, torch.from_numpy(conv.weight), padding="same")
        assert cost["sgm_float"] == products_in(counter)
        # high by coarse, high by fine, low by coarse
        assert bundle.activation_bits(cost["layer"]) == 16
        assert cost["sgm_int8"] == 3 * cost["sgm_float"]
        assert (cost["sgm_tensor_bytes_float"], cost["sgm_tensor_bytes_int8"]) == (
            4 * between,
            2 * between,
        )


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kernel", [1, 3])
def test_bytes_of_an_int8_sgm_are_those_of_its_constants(bits: ActivationBits, kernel: int) -> None:
    rng = np.random.default_rng(0)

    def conv(out: int, into: int) -> FoldedConv:
        weight = rng.normal(size=(out, into, kernel, kernel)).astype(np.float32)
        return FoldedConv(weight, rng.normal(size=out).astype(np.float32))

    sgm = FoldedSgm(3, (5, 5), (conv(12, 7), conv(9, 12), conv(4, 9)))
    inputs = rng.uniform(size=(2, 25, 7)).astype(np.float32)
    hidden = tuple(tensor.max(axis=(0, 1)) + 1 for tensor in float_trace(sgm, inputs)[1])
    ranges = SgmRanges(np.zeros(7, np.float32), np.ones(7, np.float32), hidden)
    arrays = constants(quantize_sgm(sgm, ranges, bits)).values()
    assert int8_bytes(sgm, bits) == sum(array.nbytes for array in arrays)


@pytest.mark.parametrize("tuned", range(1, 7))
def test_a_step_with_sgms_costs_what_torch_counts_and_carries_no_gradient_back(
    bundle: Bundle, costs: list[Cost], tuned: int
) -> None:
    net = ConvNet(GRASPNET).eval()
    x = torch.rand(1, 3, 128, 128)
    with torch.no_grad():
        x = net.between(x, 1, 6 - tuned) if tuned < 6 else x
    of_layers = of_sgms = 0
    for layer in range(7 - tuned, 7):
        with FlopCounterMode(display=False) as counter:
            # Its input is cut off, so that only its weight gets a gradient.
            x = net.between(x.detach(), layer, layer)
            x.sum().backward()
        of_layers += BATCH * products_in(counter)
        if layer < 6:
            with FlopCounterMode(display=False) as counter:
                run_folded_sgm(bundle.float_sgm(layer), x.detach(), torch.zeros(1, 3))
            of_sgms += BATCH * products_in(counter)
    step = step_macs(costs[-tuned:])
    assert step["sgm_float"] == of_layers + of_sgms
    assert step["sgm_int8"] == of_layers + 3 * of_sgms


def test_the_timed_step_changes_no_weight(bundle: Bundle) -> None:
    step = step_job(bundle, "int8", single_layers(bundle.network.last(3)), 1)
    losses = [step() for _ in range(3)]
    assert losses[0] == losses[1] == losses[2]


def test_every_step_is_timed_and_everything_is_in_the_json(
    bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "resources.json"
    command = ["bench", "resources", "--bundle", str(bundle_folder), "--repeats", "1"]
    assert cli.run([*command, "--json", "-o", str(path)]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values == json.loads(path.read_text())
    assert list(values["paper"]) == list(values["layers"]) == list(values["steps"])
    assert values["paper"]["4"]["printed"] == asdict(PUBLISHED[4])
    for step in values["steps"].values():
        assert set(step["ms"]) == set(step["mac"])
        assert min(step["ms"].values()) > 0


def test_the_tables_fit_into_80_columns(report: dict[str, Any]) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(render(report))
    wide = Console(width=200, record=True, file=io.StringIO())
    wide.print(render(report))
    lines = [line.rstrip() for line in console.export_text().splitlines()]
    assert max(map(len, lines)) <= 80
    tables = [line for line in wide.export_text().splitlines() if "──" in line]
    assert [line.rstrip() for line in tables] == [line for line in lines if "──" in line]
    assert "1  153,600,000  153,600,000      624      624    1,968,128  1,968,128" in "\n".join(
        lines
    )


def test_outputs_are_counted_as_documented() -> None:
    maps = [8 * 62 * 62, 8 * 29 * 29, 16 * 13 * 13, 16 * 5 * 5, 16, 0]
    pooled = [0, 0, 0, 16, 0, 3]
    layers = [4 * 32 * (2 * one + rest) for one, rest in zip(maps, pooled, strict=True)]
    for tuned in range(1, 7):
        assert output_bytes(GRASPNET, tuned) == layers[-tuned:]
