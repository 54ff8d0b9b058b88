"""The paper's experiments again, on drawn objects: what `qsgm bench paper` runs.

published     the paper's own figures
objects       six drawn objects, and their crops
driven        layers with batchnorm, trained by SGMs that follow the true gradients
pretraining   the network and its SGMs, on all objects but one
baselines/    other sources of gradients: feedback alignment, online SGMs, ...
systems       what is fine-tuned on that one, from where, by what, at which rates
experiment    all of it for every object
report        the tables, next to the paper's
"""
