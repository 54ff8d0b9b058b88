"""Post-training quantization: ranges along fine-tuning runs on the calibration set.

lessons           what is asked of a calibration set
calibration_runs  fine-tuning runs on it, as on the device
calibrate         the SGMs' ranges along those runs
sgm_fidelity      int8 SGMs along the runs, compared with float and true gradients
trunk_ranges      ranges of the frozen layers' activations
trunk             u8 features, frozen layers in int8
"""
