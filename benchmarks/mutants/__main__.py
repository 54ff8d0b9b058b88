"""Do the tests bite? Mutants of the device side and the quantizer against the tests of their lines.

    python benchmarks/mutants collect [--work DIR]
    python benchmarks/mutants run [--work DIR] [--seed 0] [--count 250] [--seconds 20]
    python benchmarks/mutants show [--work DIR] [--seed 0] [--count 250]

`collect` copies the tree to DIR and runs the suite there once under coverage (`pip install
coverage`), without what takes long and concerns something else. `run` draws mutants by the seed and
gives each the tests that run its lines, the quickest first, until one fails or they have taken so
many seconds. Everything is loaded once, and a process forked for each mutant, which gets the
function's new code. It goes on where it was stopped: what it finds is a line of DIR/log; `--again
TESTS` runs those once more that survived, against tests written since, or, without any, against
more of those there were. `show` counts: killed, equivalent (`equivalent.txt` lists them by hand),
and survivors by name.
"""

import argparse
import importlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import covering
from draw import Mutant, mutants_of
from patched import code_of

if TYPE_CHECKING:
    from covered import Covered

HERE = Path(__file__).resolve().parent
TREE = HERE.parents[1]
NEEDED = ("qsgm", "tests", "benchmarks", "examples", "deploy", "docs", "calib", "export")
FETCHED = ("node_modules", "build")
# Of CPU that a mutant may take, beside three times what its tests do, before it counts as endless.
MOST_SECONDS = 60
MOST_BYTES = 16 * 2**30
BUNDLE = "bundle_folder"  # the fixture
LOADED = ("coverage", "cv2", "onnx.helper", "onnxruntime", "pytest")
LOADED += ("rich.console", "rich.table", "torch", "typer.testing")
# Beside these two, the device side is all of `qsgm/` that is not of the host or measures.
QUANTIZER = ("qsgm/train/quantization/", "qsgm/sgm/")
ELSEWHERE = ("qsgm/train/", "qsgm/bench/", "qsgm/cli/bench.py")
# Tests that take long and run little of that.
LEFT_OUT = [
    "tests/bench",
    "tests/robustness",
    "tests/test_benchmark_scripts.py",
    *(
        f"tests/train/test_{name}.py"
        for name in (
            *("paper", "baselines", "maml", "pretrain", "episodes", "from_torch", "objects"),
            *("early", "sharing", "tasks"),
        )
    ),
]


def collect(work: Path) -> None:
    """Copy the tree and find out which test runs which line."""
    tree = work / "tree"
    shutil.rmtree(work, ignore_errors=True)
    tree.mkdir(parents=True)
    for path in sorted(TREE.iterdir()):
        if path.is_file():
            shutil.copy(path, tree)
        elif path.name in NEEDED:
            shutil.copytree(path, tree / path.name, ignore=shutil.ignore_patterns(*FETCHED))
    settings = work / "coveragerc"
    settings.write_text(
        f"[run]\ninclude = {tree}/qsgm/*\nparallel = true\ndata_file = {work}/coverage\n"
        f"context = ${{{covering.CONTEXT}-}}\ndisable_warnings = no-data-collected\n"
    )
    command = [sys.executable, "-m", "coverage"]
    environment = os.environ | {
        "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'benchmarks' / 'mutants'}",
        "COVERAGE_PROCESS_START": str(settings),
        "OMP_NUM_THREADS": "1",
        covering.TESTS: str(work / "tests.json"),
    }
    ignored = [f"--ignore={name}" for name in LEFT_OUT]
    pytest_command = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "covering", *ignored]
    for arguments in (
        ["run", f"--rcfile={settings}", *pytest_command, "tests"],
        ["combine", f"--rcfile={settings}"],
    ):
        # That some of them fail under coverage is no matter: those are left out.
        done = subprocess.run([*command, *arguments], cwd=tree, env=environment, check=False)
        if done.returncode not in (0, 1):
            raise SystemExit(f"{arguments[0]}: exit code {done.returncode}, nothing was collected")


def drawn(tree: Path, seed: int, count: int) -> list[Mutant]:
    """Mutants by chance, every one as likely as every other."""
    paths = [path.relative_to(tree).as_posix() for path in sorted(tree.glob("qsgm/**/*.py"))]
    paths = [one for one in paths if one.startswith(QUANTIZER) or not one.startswith(ELSEWHERE)]
    every = [mutant for path in paths for mutant in mutants_of(tree / path, tree)]
    return random.Random(seed).sample(every, count)


def run(
    work: Path, mutants: Sequence[Mutant], most_seconds: float, again: Sequence[str] | None
) -> None:
    """Mutants that the log does not know yet; or those that survived, against tests `again`."""
    from covered import FIXTURE, Covered

    tree, log = work / "tree", work / "log"
    covered = Covered(tree, work / "coverage", work / "tests.json")
    if again:
        shutil.rmtree(tree / "tests")
        shutil.copytree(TREE / "tests", tree / "tests")
    known = {name: entry["result"] for name, entry in _results(log).items()}
    wanted = (None,) if again is None else ("survived", "stuck")
    trials = []
    for mutant in mutants:
        if known.get(mutant.name) in wanted:
            tests = list(again) if again else _chosen(covered, mutant, most_seconds)
            makes = f"{FIXTURE}{BUNDLE}" in covered.contexts_of(mutant)
            usual = sum(covered.seconds.get(name, 0) for name in tests)
            trials.append(Trial(mutant, tests, makes, MOST_SECONDS + round(3 * usual)))
    _load(tree)
    os.chdir(tree)
    if not (work / "bundle").exists() and _code_of(lambda: _write_bundle(work / "bundle"), 600):
        shutil.rmtree(work / "bundle", ignore_errors=True)
        raise SystemExit("the bundle that most tests share could not be written")
    since = len(_lines(log))
    # Those of functions first, in a process that has everything loaded; what it could not try, as
    # it is of a module or a class, in processes that load it anew.
    for loads_anew in (False, True):
        _code_of(lambda anew=loads_anew: _try_all(trials, work, anew, since), 10**6)


def _chosen(covered: "Covered", mutant: Mutant, most_seconds: float) -> list[str]:
    """Tests for a mutant, module by module, whose fixtures are made once."""
    chosen: list[str] = []
    for name in covered.tests_of(mutant):
        most_seconds -= covered.seconds[name]
        if chosen and most_seconds < 0:
            break
        chosen.append(name)
    modules = list(dict.fromkeys(name.partition("::")[0] for name in chosen))
    return sorted(chosen, key=lambda name: modules.index(name.partition("::")[0]))


@dataclass(frozen=True)
class Trial:
    """A mutant and the tests it is to meet."""

    mutant: Mutant
    tests: list[str]
    makes_bundle: bool  # the mutant has a part in making what most tests share
    most_seconds: int  # of CPU


class Session:
    """A plugin that tries mutants, each in a process of its own, in the place of running tests."""

    def __init__(self, trials: Sequence[Trial], work: Path, loads_anew: bool) -> None:
        self._trials, self._work, self._loads_anew = trials, work, loads_anew
        self._bundle: Path | None = work / "bundle"

    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Path | None:
        """The bundle is made once, but for mutants that have a part in it."""
        if fixturedef.argname != BUNDLE or self._bundle is None:
            return None
        fixturedef.cached_result = (self._bundle, fixturedef.cache_key(request), None)
        return self._bundle

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Who kills is written down at once."""
        if report.failed:
            (self._work / "killer").write_text(report.nodeid)

    def pytest_runtestloop(self, session: Any) -> bool:
        """All of them, or the one that is loaded."""
        items = {item.nodeid: item for item in session.items}
        for trial in self._trials:
            chosen = [one for name in trial.tests for one in _under(name, items)]
            self._bundle = None if trial.makes_bundle else self._work / "bundle"
            if self._loads_anew:
                os._exit(_tested(session, chosen))
            patch = code_of(trial.mutant)
            if patch is not None or not chosen:
                _tell(self._work, trial, lambda c=chosen, p=patch: _tested(session, c, p))
        return True


def _under(name: str, items: Mapping[str, Any]) -> Iterator[Any]:
    """A test by its name, or all of a module or of a function."""
    if name in items:
        yield items[name]
    else:
        yield from (one for key, one in items.items() if key.startswith((f"{name}::", f"{name}[")))


def _tested(session: Any, items: list[Any], patch: Any = None) -> int:
    """1 where a test fails, 0 where all pass."""
    if patch is not None:
        function, function.__code__ = patch
    for item, following in zip(items, [*items[1:], None], strict=False):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.testsfailed:
            return 1
    return 0


def _try_all(trials: Sequence[Trial], work: Path, loads_anew: bool, since: int) -> int:
    """With everything loaded; or in processes that load them, those not in the log since a line."""
    import pytest

    options = ["-q", "-s", "-p", "no:cacheprovider", "--tb=line"]
    if not loads_anew:
        tests = sorted({name for trial in trials for name in trial.tests})
        return pytest.main([*options, *tests], [Session(trials, work, loads_anew)])
    left = [one for one in trials if one.mutant.name not in _results(work / "log", since)]
    for trial in left:
        plugin = Session([trial], work, loads_anew)
        _tell(work, trial, lambda p=plugin: pytest.main([*options, *p._trials[0].tests], [p]))
    return 0


def _write_bundle(folder: Path) -> int:
    sys.path[:0] = ["tests"]
    folder.mkdir()
    importlib.import_module("random_bundle").write_bundle(folder)
    return 0


def _load(tree: Path) -> None:
    """What takes long to load and is not mutated."""
    for name in LOADED:
        importlib.import_module(name)
    os.environ["PYTHONPATH"] = f"{tree}{os.pathsep}{tree / 'tests'}"
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.dont_write_bytecode = True
    sys.path[:0] = [str(tree)]


def _tell(work: Path, trial: Trial, test: Callable[[], int]) -> None:
    """Write down what tests say of a mutant: killed, endless, survived; stuck: it took no CPU."""
    path, killer, began = work / "tree" / trial.mutant.path, work / "killer", time.monotonic()
    result = "survived"
    killer.unlink(missing_ok=True)
    shutil.copy(path, work / "original")
    (work / "changed").write_text(trial.mutant.path)
    path.write_text(trial.mutant.source, encoding="utf-8")  # for programs that tests start
    code = _code_of(test, trial.most_seconds) if trial.tests else 0
    _restore(work)
    if code:
        result = {-signal.SIGXCPU: "endless", -signal.SIGALRM: "stuck"}.get(code, "killed")
    entry = {"mutant": trial.mutant.name, "line": trial.mutant.first, "result": result}
    entry |= {"tests": len(trial.tests), "seconds": round(time.monotonic() - began, 1)}
    entry["killer"] = killer.read_text() if killer.exists() else f"exit code {code}"
    with (work / "log").open("a") as file:
        file.write(f"{json.dumps(entry)}\n")


def _restore(work: Path) -> None:
    """Put back the file that is another; one that was left so by whatever ended a run, too."""
    if (work / "changed").exists():
        shutil.copy(work / "original", work / "tree" / (work / "changed").read_text())
        (work / "changed").unlink()


def _code_of(job: Callable[[], int], most_seconds: int) -> int:
    """Of a job in a process of its own; negative: the signal that ended it."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (most_seconds, most_seconds + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
        signal.alarm(20 * most_seconds if most_seconds < 10**5 else 0)  # waiting takes no CPU
        code = job()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def _lines(log: Path) -> list[str]:
    return log.read_text().splitlines() if log.exists() else []


def _results(log: Path, since: int = 0) -> dict[str, dict[str, Any]]:
    """The last word on every mutant, of what the log has from a line on."""
    return {entry["mutant"]: entry for entry in map(json.loads, _lines(log)[since:])}


def equivalent() -> dict[str, str]:
    """Reasons by the mutant's name."""
    blocks = re.split(r"\n\s*\n", (HERE / "equivalent.txt").read_text())
    pairs = [block.strip().partition("\n") for block in blocks if not block.startswith("#")]
    return {name: " ".join(reason.split()) for name, _, reason in pairs}


def show(work: Path, mutants: Sequence[Mutant]) -> None:
    """Counts, and who survived."""
    results, same = _results(work / "log"), equivalent()
    found = {one.name: results[one.name]["result"] for one in mutants if one.name in results}
    counts = Counter("equivalent" if n in same and r != "killed" else r for n, r in found.items())
    for name, result in found.items():
        if result in ("survived", "stuck") and name not in same:
            tests, line = results[name]["tests"], results[name]["line"]
            print(f"{result}, {tests} tests: line {line} of {name}")
    killed = counts["killed"] + counts["endless"]
    share = killed / max(1, len(found) - counts["equivalent"])
    print(
        f"{len(found)} of {len(mutants)}: {dict(counts)}; {share:.1%} of those that differ killed"
    )


def main() -> None:
    """Parse arguments and do one of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("collect", "run", "show"))
    parser.add_argument("--work", type=Path, default=Path("mutants"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=250)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--again", nargs="*", metavar="TEST")
    given = parser.parse_args()
    work = given.work.resolve()
    if given.what == "collect":
        collect(work)
        return
    if given.what == "run":
        _restore(work)
    if (work / "changed").exists():  # what is drawn would be changed twice
        raise SystemExit("a run goes on, or was stopped in its middle: let it end first")
    mutants = drawn(work / "tree", given.seed, given.count)
    if given.what == "run":
        run(work, mutants, given.seconds, given.again)
    show(work, mutants)


if __name__ == "__main__":
    main()
