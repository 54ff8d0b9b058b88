"""ONNX graphs of everything the device runs, in standard operators only.

build       a graph, operator by operator; a loop over crops
trunk       the network with constant weights: crops to features, a frame to its heatmap
layers      one tuned layer: forward, back through its activation, its gradients, back to its input
loss        output activation, loss and the error it starts with
sgm         a static SGM in float and in int8
optimizers  SGD with momentum and Adam, one parameter at a time
step        a whole training step, block by block; one block is backpropagation
probe       the gradients that an SGM should give, and gives in float and int8; bare outputs
loops       a step without loops, for runtimes that have none
memory      activations of a step alive at once
inspection  which operators ONNX Runtime makes of a graph
sharing     constants of all graphs in one file
short_names names as short as can be, for slim bundles
"""
