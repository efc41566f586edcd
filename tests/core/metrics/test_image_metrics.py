import math

import numpy as np
import pytest

from scas4d_core.metrics import flip, lpips, psnr, ssim


def noise(seed, shape=(24, 31, 3)):
    return np.random.default_rng(seed).random(shape)


def test_psnr_of_a_known_error():
    truth = np.full((4, 5, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)  # −10 log10(0.01)
    assert psnr(truth, truth) == math.inf


def test_psnr_clamps_what_a_display_cannot_show():
    truth = np.ones((4, 5, 3))
    assert psnr(truth + 3.0, truth) == math.inf


def test_psnr_reads_bytes_as_0_to_255():
    truth = np.full((4, 5, 3), 51, np.uint8)
    assert psnr(np.full((4, 5, 3), 0.3), truth) == pytest.approx(20.0)


def test_psnr_under_a_mask_counts_its_pixels_only():
    truth = np.zeros((2, 2, 3))
    image = truth.copy()
    image[0, 0] = 0.1
    image[1, 1] = 1.0
    mask = np.array([[1, 1], [0, 0]], np.uint8)
    assert psnr(image, truth, mask) == pytest.approx(-10 * math.log10(0.01 / 2))
    assert math.isnan(psnr(image, truth, np.zeros((2, 2))))


def direct_ssim(x, y):
    """Every window by itself, as the definition has it."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    padded_x, padded_y = (np.pad(p, ((5, 5), (5, 5), (0, 0))) for p in (x, y))
    total = []
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            for channel in range(3):
                a = padded_x[row : row + 11, column : column + 11, channel]
                b = padded_y[row : row + 11, column : column + 11, channel]
                mean_a, mean_b = (window * a).sum(), (window * b).sum()
                var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
                cov = (window * (a - mean_a) * (b - mean_b)).sum()
                total.append(
                    (2 * mean_a * mean_b + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
                )
    return np.mean(total)


def test_ssim_is_the_definition():
    x, y = noise(0), 0.5 * noise(0) + 0.5 * noise(1)
    assert ssim(x, y) == pytest.approx(direct_ssim(x, y), abs=1e-10)


def test_ssim_agrees_with_a_convolution_in_torch():
    torch = pytest.importorskip("torch")
    x, y = noise(2), noise(3)
    line = torch.exp(-((torch.arange(11.0) - 5) ** 2) / 4.5).double()
    line = line / line.sum()
    kernel = (line[:, None] * line[None]).expand(3, 1, 11, 11).contiguous()
    a, b = (torch.from_numpy(p).permute(2, 0, 1)[None] for p in (x, y))

    def mean(value):
        return torch.nn.functional.conv2d(value, kernel, padding=5, groups=3)

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    value = ((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))).mean()
    assert ssim(x, y) == pytest.approx(float(value), abs=1e-10)


def test_ssim_of_the_same_picture_is_one():
    assert ssim(noise(4), noise(4)) == pytest.approx(1.0)


def test_flip_is_zero_for_the_same_and_large_for_black_against_white():
    pytest.importorskip("flip_evaluator")
    black, white = np.zeros((32, 32, 3)), np.ones((32, 32, 3))
    assert flip(black, black).value == pytest.approx(0.0, abs=1e-6)
    assert flip(white, black).value > 0.9
    grey = np.full((32, 32, 3), 0.5)
    assert 0.01 < flip(grey + 0.05, grey).value < flip(grey + 0.2, grey).value


def test_flip_without_its_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "flip_evaluator", None)
    score = flip(noise(0), noise(1))
    assert score.value is None
    assert "pip install flip-evaluator" in score.reason


def test_lpips_without_package_or_weights_says_so_and_fetches_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    score = lpips(noise(0), noise(1))
    assert score.value is None
    assert "pip install" in score.reason or "never downloaded" in score.reason
    assert not list(tmp_path.rglob("*.pth"))


@pytest.mark.parametrize("metric", [psnr, ssim, flip, lpips])
def test_faults_are_named(metric):
    with pytest.raises(ValueError, match="render at the ground-truth size"):
        metric(noise(0), noise(0, (24, 30, 3)))
    with pytest.raises(ValueError, match="NaN"):
        metric(np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match=r"uint8, or floats in \[0, 1\]"):
        metric(np.zeros((4, 4, 3), np.int32), np.zeros((4, 4, 3)))
