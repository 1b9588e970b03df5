"""Reference values of tests/metrics.rs: python3 ssim.py > ssim.txt (scikit-image 0.26.0, numpy 2.4.6, scipy 1.17.1).

A line each: kind, width, height, ssim, mean of the full map over the mask, 4 values of the full map (channels averaged).
`-` where scikit-image has no answer.
"""
import numpy as np
from skimage.metrics import structural_similarity


def noise(n, seed):
    """The test's generator: the top 24 bits of a 64-bit LCG."""
    out = np.empty(n, np.float32)
    state = seed
    for i in range(n):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        out[i] = np.float32(state >> 40) / np.float32(2**24)
    return out


def pair(kind, width, height):
    n = width * height * 3
    a, b = noise(n, 1), noise(n, 2)
    if kind == "noise":
        pass
    elif kind == "close":
        b = (a * np.float32(0.875) + b * np.float32(0.125)).astype(np.float32)
    elif kind == "dark":
        a, b = a * np.float32(1 / 64), b * np.float32(1 / 64)
    elif kind == "flat":
        a, b = np.full(n, 0.5, np.float32), np.full(n, 0.25, np.float32)
    return [x.reshape(height, width, 3) for x in (a, b)]


def mask(width, height):
    y, x = np.mgrid[:height, :width]
    return (x * 3 + y * 5) % 7 < 3


for kind in ("noise", "close", "dark", "flat"):
    for width, height in ((7, 7), (12, 9), (33, 20)):
        a, b = (x.astype(np.float64) for x in pair(kind, width, height))
        score, full = structural_similarity(a, b, data_range=1, channel_axis=-1, full=True)
        full = full.mean(-1)
        picked = full[0, 0], full[0, width // 2], full[height // 2, width // 2], full[-1, -1]
        numbers = " ".join(f"{v:.12f}" for v in (score, full[mask(width, height)].mean(), *picked))
        print(kind, width, height, numbers)
