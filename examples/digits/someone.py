"""Digits in one hand as files: what a device is shown of it, and what it is asked then.

python examples/digits/someone.py [SEED]     # writes shown.npz and asked.npz
"""

import sys
from pathlib import Path

import numpy as np

from qsgm import load_task

SHOWN, ASKED = 200, 100

seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
task = load_task(Path(__file__).with_name("digits_task.py"))
both = task.met(np.random.default_rng(seed), SHOWN + ASKED)
for name, half in (("shown", slice(SHOWN)), ("asked", slice(SHOWN, None))):
    np.savez(f"{name}.npz", samples=both.inputs[half], labels=both.labels[half])
