"""One training step in other frameworks, for `qsgm bench speed`.

step_data           the job: features, labels, weights, batches, and the losses to expect (qsgm's)
torch_steps         torch, eager and compiled, and executorch's training extension
ort_training_steps  onnxruntime-training

The last two are scripts that import nothing of qsgm, since they run under other interpreters:
onnxruntime-training takes the place of onnxruntime, and executorch wants its own torch.
"""
