"""Numbers that the command line shows before anything heavy is imported."""

EPOCHS = 20
SHORT_RUNS = "1,3"  # epochs, of `bench accuracy`
LAYERS = 3  # tuned
MOST_LAYERS = 6  # that can be tuned
PROBE_EVERY = 25  # steps: once per epoch
CALIBRATION_FRAMES = 24
