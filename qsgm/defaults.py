"""Numbers that the command line shows before anything heavy is imported."""

import os
from typing import Literal

EPOCHS = 10  # over an object's 800 crops: twice as many do no better (docs/design.md)
SAMPLE_EPOCHS = 20  # over samples of one's own, which may be few
SHORT_RUNS = "1,3"  # epochs, of `bench accuracy`
LAYERS = 3  # tuned
# Of the SGMs: as accurate as int8 and the quicker one at these widths (docs/cost.md).
PRECISION: Literal["int8", "float"] = "float"
SLIM_BLOCKS = "4,5,6"  # those, each on its own
PROBE_EVERY = 25  # steps: once per epoch
CALIBRATION_FRAMES = 24
THREAD_COUNTS = "1,2" if (os.cpu_count() or 1) > 1 else "1"  # of single steps, in `bench speed`
