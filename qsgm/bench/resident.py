"""Run a module as `python -m` does, and write down how much memory its process held at most.

    python -m qsgm.bench.resident FILE MODULE ARGUMENTS

The file gets a number: bytes, the high-water mark of resident memory (Linux). Read from inside:
what a parent learns of a child may be the parent's own, from before the child was another program.
"""

import re
import runpy
import sys
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_resident_bytes() -> int:
    """Of this process, so far."""
    found = re.search(r"^VmHWM:\s*(\d+) kB$", STATUS.read_text(encoding="ascii"), re.MULTILINE)
    assert found is not None, "Linux says VmHWM of every process that has memory"
    return 1024 * int(found[1])


def main() -> None:
    """Run the module; the file is written however it ends."""
    _, file, module, *arguments = sys.argv
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        Path(file).write_text(str(peak_resident_bytes()), encoding="ascii")


if __name__ == "__main__":
    main()
