"""The network and its SGMs in torch: layers, local updates, batchnorm folded."""
