"""Error measures: by hand, against scikit-image, and where they have no value."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from splatpipe.shared import metrics
from splatpipe.shared.errors import DeviceError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY

EMPTY = int(FRAMEBUFFER_EMPTY)


def picture(seed=0, shape=(24, 31, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def word(depth, colour=0xFF000000):
    return int(np.float32(depth).view(np.uint32)) << 32 | colour


def frame(*words):
    return np.array([words], np.uint64)


def test_rmse_and_psnr_by_hand():
    reference, test = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2, 3), np.uint8)
    test[0, 1] = 255
    assert metrics.rmse(reference, test) == pytest.approx(255 / math.sqrt(2))
    assert metrics.psnr_db(255 / math.sqrt(2)) == pytest.approx(10 * math.log10(2))
    assert metrics.psnr_db(255.0) == 0.0
    assert metrics.rmse(reference[:0], test[:0]) is None
    assert metrics.psnr_db(None) is None


def test_unsigned_differences_do_not_wrap():
    dark, bright = np.full((1, 1, 3), 3, np.uint8), np.full((1, 1, 3), 5, np.uint8)
    assert metrics.rmse(dark, bright) == metrics.rmse(bright, dark) == 2.0


def test_equal_pictures_have_the_best_value_of_every_measure():
    image = picture()
    assert metrics.rmse(image, image) == 0
    assert metrics.psnr_db(0.0) == metrics.PSNR_CAP_DB
    assert metrics.psnr_db(1e-9) == metrics.PSNR_CAP_DB
    assert metrics.ssim(image, image) == pytest.approx(1.0)
    assert metrics.flip(image, image) == 0.0


def test_psnr_equals_scikit_image():
    from skimage.metrics import peak_signal_noise_ratio

    reference, test = picture(1), picture(2)
    assert metrics.psnr_db(metrics.rmse(reference, test)) == pytest.approx(peak_signal_noise_ratio(reference, test))


def test_ssim_of_two_flat_greys_is_its_luminance_term():
    a, b, c1 = 100.0, 120.0, (0.01 * 255) ** 2
    found = metrics.ssim(np.full((16, 16, 3), 100, np.uint8), np.full((16, 16, 3), 120, np.uint8))
    assert found == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1))


def test_ssim_equals_its_definition_with_a_gaussian_window():
    from scipy.ndimage import correlate1d

    reference, test = picture(3)[..., 0].astype(float), picture(4)[..., 0].astype(float)
    tap = np.exp(-0.5 * (np.arange(-5, 6) / metrics.SSIM_SIGMA_PX) ** 2)
    assert len(tap) == metrics.SSIM_WINDOW_PX

    def mean(image):
        for axis in (0, 1):
            image = correlate1d(image, tap / tap.sum(), axis)
        return image

    mx, my = mean(reference), mean(test)
    vx, vy = mean(reference**2) - mx**2, mean(test**2) - my**2
    covariance = mean(reference * test) - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    of_pixel = (2 * mx * my + c1) * (2 * covariance + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    grey = [np.repeat(image.astype(np.uint8)[..., None], 3, axis=2) for image in (reference, test)]
    assert metrics.ssim(*grey) == pytest.approx(of_pixel[5:-5, 5:-5].mean(), abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1, 3), (10, 40, 3), (40, 10, 3)])
def test_a_picture_smaller_than_the_window_has_no_ssim_and_still_the_rest(shape):
    reference, test = np.zeros(shape, np.uint8), np.full(shape, 255, np.uint8)
    assert metrics.ssim(reference, test) is None
    assert metrics.rmse(reference, test) == 255
    assert metrics.flip(reference, test) > 0.9


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.data())
def test_flip_lies_between_nothing_and_one_and_rises_with_contrast(data):
    shape = (*data.draw(array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)), 3)
    reference = data.draw(arrays(np.uint8, shape))
    far = metrics.flip(reference, 255 - reference)
    near = metrics.flip(reference, np.clip(reference.astype(int) + 1, 0, 255).astype(np.uint8))
    assert 0 <= near <= 1
    assert 0 <= far <= 1
    if np.abs(reference.astype(int) - 127).min() > 100:
        assert near < far


def test_coverage_counts_holes_and_false_pixels_on_the_foreground_of_the_reference():
    reference = frame(word(1), word(1), word(1), word(1), EMPTY, EMPTY)
    test = frame(word(9, 7), EMPTY, word(1), EMPTY, word(1), EMPTY)
    found = metrics.coverage(reference, test)
    assert (found.holes, found.false_pixels, found.error) == (0.5, 0.25, 0.75)
    assert metrics.coverage(reference, reference).error == 0


def test_a_reference_without_points_has_neither_coverage_nor_depth():
    empty, test = frame(EMPTY, EMPTY), frame(word(1), EMPTY)
    found = metrics.coverage(empty, test)
    assert (found.holes, found.false_pixels, found.error) == (None, None, None)
    assert metrics.depth_rmse(empty, test) is None
    assert metrics.depth_rmse(test, empty) is None
    assert metrics.coverage(test, empty).holes == 1


def test_depth_rmse_is_of_the_pixels_that_both_cover():
    reference = frame(word(1.0), word(2.0), word(50.0), EMPTY)
    test = frame(word(4.0, 1), word(6.0, 2), EMPTY, word(8.0))
    assert metrics.depth_rmse(reference, test) == pytest.approx(math.sqrt((9 + 16) / 2))


def test_a_missing_package_is_named_with_what_to_install(monkeypatch):
    metrics.check_installed()
    monkeypatch.setattr(metrics, "find_spec", lambda name: None if name == "flip_evaluator" else name)
    with pytest.raises(DeviceError, match=r"FLIP: flip_evaluator is missing; install splatpipe\[error\]"):
        metrics.check_installed()


def test_pictures_of_two_sizes_are_refused():
    for measure in (metrics.rmse, metrics.ssim, metrics.flip, metrics.coverage, metrics.depth_rmse):
        with pytest.raises(ValueError, match="two sizes"):
            measure(picture(), picture(shape=(3, 31, 3)))
