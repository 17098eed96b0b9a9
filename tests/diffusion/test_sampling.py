"""Schedules against closed forms; samples depend on their seed alone."""

import pytest
import torch

from illuminerf.diffusion.objective import signal_and_noise, stratified_timesteps
from illuminerf.diffusion.relighting_model import noise_schedule
from illuminerf.diffusion.sampling import sample_relit, sampling_schedule
from tests.diffusion.tiny import random_condition_inputs, tiny_model, with_noise_in_every_weight


def test_cosine_schedule_closed_form() -> None:
    timesteps = torch.tensor([0, 250, 500, 900])
    signal, sigma = signal_and_noise(timesteps)
    torch.testing.assert_close(signal**2 + sigma**2, torch.ones(4, 1, 1, 1))
    angle = ((timesteps + 1) / 1000 + 0.008) / 1.008 * torch.pi / 2
    expected = torch.cos(angle) ** 2 / torch.cos(torch.tensor(0.008 / 1.008 * torch.pi / 2)) ** 2
    torch.testing.assert_close(signal.flatten() ** 2, expected.float(), rtol=1e-3, atol=1e-5)
    assert float(signal_and_noise(torch.tensor([999]))[0]) < 1e-2


def test_stratified_timesteps_fill_every_stratum() -> None:
    timesteps = stratified_timesteps(10, torch.Generator().manual_seed(0))
    assert sorted((timesteps // 100).tolist()) == list(range(10))
    assert timesteps.tolist() != sorted(timesteps.tolist())


def test_ancestral_step_is_the_ddpm_posterior() -> None:
    """q(x_{t-1} | x_t, x_0) of Ho et al. 2020, eq. 7, from v-prediction."""
    scheduler = sampling_schedule("ddpm", 1000)
    cumulative = noise_schedule().alphas_cumprod.double()
    t = 600
    clean, noisy = torch.full((1, 1, 1, 1), 0.3).double(), torch.full((1, 1, 1, 1), -0.8).double()
    noise = (noisy - cumulative[t].sqrt() * clean) / (1 - cumulative[t]).sqrt()
    velocity = cumulative[t].sqrt() * noise - (1 - cumulative[t]).sqrt() * clean
    draws = torch.cat(
        [
            scheduler.step(velocity, t, noisy, generator=torch.Generator().manual_seed(k)).prev_sample
            for k in range(2000)
        ]
    )
    step = cumulative[t] / cumulative[t - 1]
    mean = (cumulative[t - 1].sqrt() * (1 - step) * clean + step.sqrt() * (1 - cumulative[t - 1]) * noisy) / (
        1 - cumulative[t]
    )
    variance = (1 - cumulative[t - 1]) / (1 - cumulative[t]) * (1 - step)
    assert float(draws.mean()) == pytest.approx(float(mean), abs=4 * float(variance / 2000) ** 0.5)
    assert float(draws.var()) == pytest.approx(float(variance), rel=0.15)


@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver", "ddpm"])
def test_samplers_find_a_known_point(sampler: str) -> None:
    """With the exact v of a point distribution every sampler must end on the point."""
    scheduler = sampling_schedule(sampler, 8)  # type: ignore[arg-type]
    assert int(scheduler.timesteps[0]) == 999 and len(scheduler.timesteps) == 8
    cumulative = noise_schedule().alphas_cumprod
    point = torch.tensor([0.7, -1.1]).reshape(1, 2, 1, 1)
    latent = torch.randn(1, 2, 1, 1)
    extra = {"generator": torch.Generator().manual_seed(0)} if sampler == "ddpm" else {}
    for timestep in scheduler.timesteps:
        signal, sigma = cumulative[timestep].sqrt(), (1 - cumulative[timestep]).sqrt()
        velocity = signal * (latent - signal * point) / sigma - sigma * point
        latent = scheduler.step(velocity, timestep, latent, return_dict=False, **extra)[0]
    torch.testing.assert_close(latent, point, atol=0.03, rtol=0)


def test_a_seed_decides_a_sample_whatever_the_batch() -> None:
    model = with_noise_in_every_weight(tiny_model())
    image, cues = random_condition_inputs(3, 32)
    for sampler in ("ddim", "ddpm"):
        together = sample_relit(model, image, cues, [[1, 2], [3, 4], [5, 6]], 3, sampler)  # type: ignore[arg-type]
        alone = sample_relit(model, image[1:2], cues[1:2], [[4]], 3, sampler)  # type: ignore[arg-type]
        assert together.shape == (3, 2, 3, 32, 32)
        torch.testing.assert_close(together[1, 1], alone[0, 0], atol=1e-4, rtol=0)
        assert (together[1, 0] - together[1, 1]).abs().max() > 1e-2


def test_samples_are_black_off_the_object_and_in_range() -> None:
    model = with_noise_in_every_weight(tiny_model())
    image, cues = random_condition_inputs(1, 32)
    image[:, :, :, :16] = 0
    relit = sample_relit(model, image, cues, [[0]], 2)
    assert (relit[..., :16] == 0).all() and float(relit.min()) >= 0 and float(relit.max()) <= 1


def test_uneven_seeds_are_refused() -> None:
    image, cues = random_condition_inputs(2, 32)
    with pytest.raises(ValueError, match="one length"):
        sample_relit(tiny_model(), image, cues, [[1], [2, 3]], 2)
