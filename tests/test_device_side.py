"""The device has no torch, onnx, onnxscript or matplotlib: no module outside qsgm/train needs them.

The linter sees direct imports only; a fresh interpreter sees what really gets loaded.
"""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import qsgm

HOST_ONLY = ("torch", "onnx", "onnxscript", "matplotlib")

# Imports modules one by one and prints, for each, which of the banned ones it brought in.
PROBE = """
import importlib, json, sys
modules, banned = json.loads(sys.argv[1])
report = {}
for module in modules:
    before = set(sys.modules)
    importlib.import_module(module)
    report[module] = [name for name in banned if name in set(sys.modules) - before]
print(json.dumps(report))
"""


def device_modules() -> list[str]:
    """Every module of the package outside qsgm.train; ``__main__`` would run the command line."""
    top = Path(qsgm.__file__).parent
    files = [file.relative_to(top.parent).with_suffix("") for file in top.rglob("*.py")]
    names = {".".join(file.parts).removesuffix(".__init__") for file in files}
    return sorted(
        name
        for name in names
        if not name.endswith("__main__") and not (name + ".").startswith("qsgm.train.")
    )


def brought_in(modules: list[str], banned: tuple[str, ...] = HOST_ONLY) -> dict[str, list[str]]:
    done = subprocess.run(
        [sys.executable, "-c", PROBE, json.dumps([modules, banned])],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(qsgm.__file__).parent.parent,
    )
    assert done.returncode == 0, done.stderr
    report: dict[str, list[str]] = json.loads(done.stdout)
    return report


def test_no_device_module_imports_a_host_library() -> None:
    modules = device_modules()
    assert {"qsgm", "qsgm.grasp.crops", "qsgm.grasp.heatmap"} <= set(modules)
    report = brought_in(modules)
    assert list(report) == modules
    assert {module: names for module, names in report.items() if names} == {}


def test_the_probe_sees_an_import_that_is_not_direct() -> None:
    # qsgm.grasp.heatmap reaches OpenCV only through qsgm.grasp.crops.
    assert brought_in(["qsgm.grasp.heatmap"], ("cv2",)) == {"qsgm.grasp.heatmap": ["cv2"]}


def test_no_device_module_imports_a_host_library_even_inside_a_function() -> None:
    top = Path(qsgm.__file__).parent
    found = []
    for file in top.rglob("*.py"):
        if "train" in file.relative_to(top).parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found += [(file.name, n) for n in names if n.partition(".")[0] in HOST_ONLY]
    # Charts need matplotlib, and no module needs charts before it draws one.
    charts = [one for one in found if one[0] == "charts.py" and one[1].startswith("matplotlib")]
    assert [one for one in found if one not in charts] == []


def test_the_command_line_starts_without_onnx_runtime_and_opencv() -> None:
    assert brought_in(["qsgm.cli"], ("onnxruntime", "cv2", "numpy")) == {"qsgm.cli": []}


def test_every_export_is_what_it_says_even_after_its_module_was_imported() -> None:
    import qsgm.grasp.teach

    assert qsgm.finetune is qsgm.grasp.teach.finetune
    assert all(getattr(qsgm, name) is not None for name in qsgm.__all__)
    assert not any((Path(qsgm.__file__).parent / f"{name}.py").exists() for name in qsgm.__all__)
    with pytest.raises(AttributeError, match="'qsgm' has no attribute 'nothing'"):
        qsgm.nothing  # noqa: B018
