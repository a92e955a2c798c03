"""How far a picture is from its reference: image, coverage and depth errors.

Images are (h, w, 3) uint8 sRGB; frames are (h, w) uint64 framebuffer words. A measure that has no value for its
input (nothing to compare, or an image smaller than a window) is None, and the docstring says when.

Sparse points leave most of a picture to the background, which flatters every whole-image measure; hence the measures
on the reference's foreground, the pixels that some point of the reference covers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from .errors import DeviceError
from .messages import FRAMEBUFFER_EMPTY

PSNR_CAP_DB = 100.0
"""PSNR of images that are equal, or differ so little that it would be more."""

SSIM_SIGMA_PX = 1.5
SSIM_WINDOW_PX = 11
"""The Gaussian window of SSIM: standard deviation and side."""

_PEAK = 255.0


def check_installed() -> None:
    """Raise DeviceError unless the packages that SSIM and FLIP come from are there."""
    for package, measure in (("skimage", "SSIM"), ("flip_evaluator", "FLIP")):
        if find_spec(package) is None:
            raise DeviceError(f"{measure}: {package} is missing; install splatpipe[error]")


def rmse(reference: np.ndarray, test: np.ndarray) -> float | None:
    """Root of the mean squared difference over all entries of two arrays of one shape; None if they are empty."""
    _same_shape(reference, test)
    if reference.size == 0:
        return None
    return float(np.sqrt(np.mean((reference.astype(np.float64) - test) ** 2)))


def psnr_db(error: float | None) -> float | None:
    """Peak signal-to-noise ratio of an RMSE over 0…255, in decibels, at most ``PSNR_CAP_DB``; None for None."""
    if error is None:
        return None
    return min(20 * math.log10(_PEAK / error), PSNR_CAP_DB) if error > 0 else PSNR_CAP_DB


def ssim(reference: np.ndarray, test: np.ndarray) -> float | None:
    """Mean structural similarity over pixels and channels, 1 for equal images.

    None where a side is below ``SSIM_WINDOW_PX``. Gaussian window, population covariance, as published.
    Cost: about 0.4 µs a pixel.
    Source: Wang, Bovik, Sheikh, Simoncelli 2004, "Image Quality Assessment: From Error Visibility to Structural
    Similarity".
    """
    _same_shape(reference, test)
    if min(reference.shape[:2]) < SSIM_WINDOW_PX:
        return None
    from skimage.metrics import structural_similarity

    mean: Any = structural_similarity(
        reference,
        test,
        gaussian_weights=True,
        sigma=SSIM_SIGMA_PX,
        use_sample_covariance=False,
        data_range=_PEAK,
        channel_axis=2,
    )
    return float(mean)


def flip(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean FLIP, the difference seen when alternating two images: 0 equal … 1.

    At the evaluator's default of 67 pixels a degree of visual angle (a 0.7 m wide 4K display at 0.7 m).
    Cost: about 2 µs a pixel.
    Source: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images".
    """
    _same_shape(reference, test)
    import flip_evaluator

    images = [np.ascontiguousarray(image, np.float32) / np.float32(_PEAK) for image in (reference, test)]
    mean: Any = flip_evaluator.evaluate(images[0], images[1], "LDR", applyMagma=False)[1]
    return float(mean)


@dataclass(frozen=True)
class Coverage:
    """Pixels covered wrongly, as shares of the pixels that the reference covers; None where it covers none.

    holes : covered by the reference and not by the frame, 0…1.
    false_pixels : covered by the frame and not by the reference; above 1 if there are more than the reference covers.
    """

    holes: float | None
    false_pixels: float | None

    @property
    def error(self) -> float | None:
        """Holes and false pixels together."""
        return None if self.holes is None or self.false_pixels is None else self.holes + self.false_pixels


def coverage(reference: np.ndarray, test: np.ndarray) -> Coverage:
    """Which pixels two frames cover; what they show there does not matter."""
    _same_shape(reference, test)
    wanted, covered = foreground(reference), foreground(test)
    n_wanted = int(wanted.sum())
    if n_wanted == 0:
        return Coverage(None, None)
    return Coverage(float((wanted & ~covered).sum() / n_wanted), float((covered & ~wanted).sum() / n_wanted))


def depth_rmse(reference: np.ndarray, test: np.ndarray) -> float | None:
    """RMSE of depth along the view axis, world units, over the pixels that both frames cover; None if there are none.

    A point seen through a hole counts with its whole distance, so this is large where a surface is thinned.
    """
    _same_shape(reference, test)
    both = foreground(reference) & foreground(test)
    return rmse(depth(reference[both]), depth(test[both]))


def foreground(words: np.ndarray) -> np.ndarray:
    """Bool array of framebuffer words: where some point fell."""
    return words != FRAMEBUFFER_EMPTY


def depth(words: np.ndarray) -> np.ndarray:
    """Float32 array of framebuffer words: distance along the view axis; not a number where no point fell."""
    return (words >> np.uint64(32)).astype(np.uint32).view(np.float32)


def _same_shape(reference: np.ndarray, test: np.ndarray) -> None:
    if reference.shape != test.shape:
        raise ValueError(f"pictures of two sizes: reference {reference.shape}, test {test.shape}")
