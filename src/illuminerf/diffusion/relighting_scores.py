"""How good relit images are: PSNR and SSIM over the object, after the best scale per image and colour channel.

The scale (least squares in linear light) takes out what a single image cannot tell: albedo against exposure.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from illuminerf.diffusion.augmentation import plain_example, stack_examples
from illuminerf.diffusion.cue_coding import decode_cues, encode_cues
from illuminerf.diffusion.materials import composited
from illuminerf.diffusion.relighter import Relighter
from illuminerf.diffusion.sampling import Sampler, sample_relit
from illuminerf.diffusion.training_items import TrainingItem
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear


def rescaled(
    estimate: Float[Tensor, "batch 3 height width"], target: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """`estimate` times the least-squares scale per image and channel in linear light; sRGB in, sRGB out."""
    ours, truth = linear_from_srgb(estimate), linear_from_srgb(target)
    scale = (ours * truth).sum((2, 3)) / ours.square().sum((2, 3)).clamp_min(1e-8)
    return srgb_from_linear(ours * scale[:, :, None, None]).clamp(0, 1)


def masked_psnr(
    estimate: Float[Tensor, "batch 3 height width"],
    target: Float[Tensor, "batch 3 height width"],
    alpha: Float[Tensor, "batch 1 height width"],
) -> Float[Tensor, " batch"]:
    """PSNR per image over pixels with alpha > 0.5."""
    mask = (alpha > 0.5).float()
    errors = ((estimate - target).square() * mask).sum((1, 2, 3)) / (3 * mask.sum((1, 2, 3))).clamp_min(1)
    return -10 * errors.clamp_min(1e-10).log10()


def masked_ssim(
    estimate: Float[Tensor, "batch 3 height width"],
    target: Float[Tensor, "batch 3 height width"],
    alpha: Float[Tensor, "batch 1 height width"],
) -> Float[Tensor, " batch"]:
    """SSIM per image (11x11 Gaussian of sigma 1.5, "valid"), averaged over window centres with alpha > 0.5."""
    offsets = torch.arange(11) - 5
    line = torch.exp(-offsets.square() / (2 * 1.5**2)).to(estimate)
    line /= line.sum()
    window = (line[:, None] * line).expand(3, 1, 11, 11)

    def blurred(image: Tensor) -> Tensor:
        return functional.conv2d(image, window, groups=3)

    mean_a, mean_b = blurred(estimate), blurred(target)
    var_a, var_b = blurred(estimate.square()) - mean_a**2, blurred(target.square()) - mean_b**2
    covariance = blurred(estimate * target) - mean_a * mean_b
    structure = (2 * covariance + 0.03**2) / (var_a + var_b + 0.03**2)
    ssim = structure * (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    mask = (alpha[:, :, 5:-5, 5:-5] > 0.5).float()
    return (ssim * mask).sum((1, 2, 3)) / (3 * mask.sum((1, 2, 3))).clamp_min(1)


def held_out_pairs(items: list[TrainingItem], num_pairs: int) -> list[tuple[TrainingItem, int, int]]:
    """Deterministic (item, input light, target light), all different, spread over items and lights.

    There are fewer than `num_pairs` where the items' lights allow no more.
    """
    pairs: list[tuple[TrainingItem, int, int]] = []
    stride = max(1, len(items) // num_pairs)
    chosen = list(enumerate(items))[::stride][:num_pairs]
    rounds = max(len(item.targets) * (len(item.targets) - 1) for item in items)
    for index in range(len(chosen) * rounds):
        number, item = chosen[index % len(chosen)]
        lights, turn = len(item.targets), index // len(chosen)
        orders = lights * (lights - 1)
        if turn < orders and len(pairs) < num_pairs:
            # Each turn takes another of the item's ordered pairs of lights: steps of a number prime to their count.
            start = (number % lights) * (lights - 1) + (number // lights) % (lights - 1)
            step = next(k for k in range(orders // 2 + 1, 2 * orders + 2) if math.gcd(k, orders) == 1)
            first, offset = divmod((start + turn * step) % orders, lights - 1)
            pairs.append((item, first, (first + 1 + offset) % lights))
    return pairs


@torch.inference_mode()
def evaluate(
    model: Relighter,
    items: list[TrainingItem],
    num_pairs: int = 24,
    num_samples: int = 4,
    num_steps: int = 8,
    sampler: Sampler = "ddim",
    batch_size: int = 8,
    temperature: float = 1.0,
    knows_shading: bool = False,
) -> tuple[dict[str, dict[str, float]], dict[str, Float[Tensor, "pairs 3 height width"]]]:
    """Scores by estimate ({name: {psnr, ssim}}), and the images, on held-out items.

    Estimates: input (the image itself), mean_albedo (its mean albedo * diffuse cue), anchor (products alone, of
    models that have one), sample (one sample, averaged), mean (mean of samples), best (best sample), bound (true
    materials).
    `knows_shading` tells the model the diffuse cue under the input light, which single photographs come without.
    `spread` is the samples' standard deviation over covered pixels, in sRGB.
    """
    pairs = held_out_pairs(items, num_pairs)
    examples = [plain_example(*pair, knows_shading=knows_shading) for pair in pairs]
    batch = stack_examples(examples, model.cue_coding)
    linear_cues = torch.stack([example.cues for example in examples])
    diffuse_cues = encode_cues(linear_cues)[:, :3]
    samples, anchors = [], []
    for start in range(0, len(pairs), batch_size):
        rows = slice(start, start + batch_size)
        image, cues = batch.masked_image[rows].to(model.device), batch.coded_cues[rows].to(model.device)
        shading = batch.shading[rows].to(model.device)
        seeds = [[1000 * (start + i) + k for k in range(num_samples)] for i in range(len(image))]
        samples.append(sample_relit(model, image, cues, seeds, num_steps, sampler, temperature, 0, shading).cpu())
        if model.latent_is_residual:
            anchors.append(model.anchor(model.condition(image, cues, shading), image[:, 3:]).float().cpu())
    drawn = torch.cat(samples)
    bound = composited(batch.surface, linear_cues)
    images = {
        "input": batch.masked_image[:, :3],
        "mean_albedo": _mean_albedo_estimate(batch.masked_image, decode_cues(diffuse_cues)),
        "mean": drawn.mean(1),
        "bound": srgb_from_linear(bound).clamp_max(1) * batch.alpha,
    }
    if anchors:
        images["anchor"] = torch.cat(anchors)
    truth, alpha = batch.target, batch.alpha
    scores = {name: _scores(image, truth, alpha) for name, image in images.items()}
    ours = [rescaled(drawn[:, k], truth) for k in range(num_samples)]
    psnr = torch.stack([masked_psnr(one, truth, alpha) for one in ours])
    ssim = torch.stack([masked_ssim(one, truth, alpha) for one in ours])
    scores["sample"] = {"psnr": float(psnr.mean()), "ssim": float(ssim.mean())}
    scores["best"] = {"psnr": float(psnr.max(0).values.mean()), "ssim": float(ssim.max(0).values.mean())}
    deviation = drawn.std(1) if num_samples > 1 else torch.zeros_like(truth)
    scores["spread"] = {"srgb": float((deviation * alpha).sum() / (3 * alpha.sum()))}
    return scores, images | {"truth": truth, "sample": drawn[:, 0], "diffuse_cue": diffuse_cues}


def _scores(estimate: Tensor, truth: Tensor, alpha: Tensor) -> dict[str, float]:
    ours = rescaled(estimate, truth)
    return {
        "psnr": float(masked_psnr(ours, truth, alpha).mean()),
        "ssim": float(masked_ssim(ours, truth, alpha).mean()),
    }


def _mean_albedo_estimate(masked_image: Tensor, diffuse: Tensor) -> Tensor:
    """One colour for the whole object, from the image's mean, times the diffuse cue."""
    alpha = masked_image[:, 3:]
    linear = linear_from_srgb(masked_image[:, :3])
    mean = (linear * alpha).sum((2, 3), keepdim=True) / alpha.sum((2, 3), keepdim=True).clamp_min(1)
    return srgb_from_linear(mean * diffuse).clamp_max(1) * alpha
