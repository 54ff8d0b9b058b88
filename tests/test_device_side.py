"""The device has no torch, onnx, onnxscript or matplotlib: no module outside qsgm/train needs them.

The linter sees direct imports only; a fresh interpreter sees what really gets loaded.
"""

import json
import subprocess
import sys
from pathlib import Path

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
    assert {"qsgm", "qsgm.crops", "qsgm.predict"} <= set(modules)
    report = brought_in(modules)
    assert list(report) == modules
    assert {module: names for module, names in report.items() if names} == {}


def test_the_probe_sees_an_import_that_is_not_direct() -> None:
    # qsgm.predict reaches OpenCV only through qsgm.crops.
    assert brought_in(["qsgm.predict"], ("cv2",)) == {"qsgm.predict": ["cv2"]}
