"""Cases of the codecs."""

from __future__ import annotations

from .case import out_of_reach

autocorrelation = out_of_reach(
    "codec/FFT autocorrelation",
    "Counts of the most common translations by FFT autocorrelation against integers, and their margin to 0.5.",
    "the transformation-stream codec is not built yet; it brings the measurement with it",
)
