"""What `qsgm bench paper` says about its figures and the paper's: how the settings differ."""

NOTES: tuple[str, ...] = (
    "The objects are drawn, not photographed, and a network that has seen five of them has seen "
    "five tables and one light each.",
    "The paper does not say how long it trains: here 1000 steps for the network, 3000 for the SGMs "
    "and 30 epochs of fine-tuning. Nor does it say whether the pool takes the maximum or, as here, "
    "the mean.",
    "The paper names a momentum of 0.9 for pretraining; of fine-tuning it says the rate alone. "
    "Static SGMs on batchnorm converge without momentum, and with it blow up in the end.",
    "A step at 0.1 is one through batchnorm in the paper. On folded weights, which is what a "
    "device has, the same rate is another step, and mostly one too far.",
    "The paper's encoding of the angle jumps at 90 degrees, for every method alike. An angle's "
    "zero is the demonstration as it lies, in every object another direction.",
    "The paper's Table 1 averages over seven objects and shows six: the printed spreads come out "
    "with a seventh, which Table 2 shows as its f, leaving out Table 1's c.",
)
