"""Numbers that the command line shows before anything heavy is imported."""

EPOCHS = 20
LAYERS = 3  # tuned
MOST_LAYERS = 3  # that can be tuned
CALIBRATION_FRAMES = 24
