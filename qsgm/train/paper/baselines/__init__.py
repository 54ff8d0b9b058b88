"""The systems that static SGMs are compared with, each as a source of gradients.

interface            what a baseline is given of a batch, and what it has to yield
backpropagation      true gradients
feedback_alignment   backpropagation with fixed random matrices for the transposed weights
projections          fixed random matrices to every layer, for the next two
direct_feedback      fixed random projections of the output error
target_projection    fixed random projections of the label
static_sgms          synthetic gradients that stay as they are, with and without the label
online_sgms          synthetic gradients that go on learning
tuning               fine-tune a set of tasks with any of them
"""
