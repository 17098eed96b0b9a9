import numpy as np
import pytest

from illuminerf.scene.tone import compressed, expanded
from illuminerf.workflow.errors import UserError


@pytest.mark.parametrize("peak", [1.0, 2.0, 16.0, 1e4])
def test_expanding_undoes_compressing(peak: float) -> None:
    radiance = np.random.default_rng(0).uniform(0, peak, (500, 3)).astype(np.float32)
    np.testing.assert_allclose(expanded(compressed(radiance, peak), peak), radiance, rtol=2e-3 if peak > 100 else 1e-4)
    if peak > 1:
        assert np.abs(expanded(compressed(radiance, peak), 2 * peak) - radiance).max() > 0.1, "another peak must fail"


def test_a_peak_of_one_changes_nothing_and_the_dark_is_left_alone() -> None:
    radiance = np.random.default_rng(0).uniform(0, 1, (100, 3))
    np.testing.assert_allclose(compressed(radiance, 1.0), radiance, atol=1e-6)
    np.testing.assert_allclose(expanded(1e-3 * radiance, 50.0), 1e-3 * radiance, rtol=2e-3)


def test_white_becomes_the_peak_and_hues_stay() -> None:
    np.testing.assert_allclose(expanded(np.array([[1.0, 0.5, 0.25]]), 16.0), [[16, 8, 4]], rtol=1e-6)


def test_a_peak_below_one_is_refused() -> None:
    with pytest.raises(UserError, match="peak"):
        expanded(np.ones((1, 3)), 0.5)
