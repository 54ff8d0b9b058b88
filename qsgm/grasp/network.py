"""GraspNet's geometry (paper section 3.1, "The Model").

Six convolutions; 5x5 average pooling behind the fourth. A 128x128 crop gives one output, a 480x640
frame a heatmap of 23x33: the same network, fully convolutional. The pool's kind is not stated in
the paper; this one averages.
"""

from qsgm.network import Network, conv

CROP_PX = 128
GRASPNET = Network(
    (CROP_PX, CROP_PX, 3),
    (
        conv(3, 8, 5, stride=2),
        conv(8, 8, 5, stride=2),
        conv(8, 16, 5, stride=2),
        conv(16, 16, 5, stride=2, pool=5),
        conv(16, 16),
        conv(16, 3, relu=False),
    ),
)
