"""One wearer's sets as files: what a watch is shown of them, and what it is asked then.

python examples/watch/wearer.py [PERSON]     # 0 to 9; writes shown/*.npz and asked/*.npz
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np

person = int(sys.argv[1]) if len(sys.argv) > 1 else 9
file = Path(find_spec("seglearn").origin).parent / "data" / "watch_dataset.npy"
sets = np.load(file, allow_pickle=True).item()
right = sets["side"] == 1
for i in np.flatnonzero((sets["subject"] == person + 1) & right):
    third = len(sets["X"][i]) // 3
    for name, some in (("shown", slice(third)), ("asked", slice(third, None))):
        Path(name).mkdir(exist_ok=True)
        kind = int(sets["y"][i])
        path = Path(name) / f"{sets['y_labels'][kind]}.npz"
        np.savez(path, motion=sets["X"][i][some], arm=1, exercise=kind)
