"""How fast the relighting model samples: images per second by step count, and where the time goes, as JSON.

python benchmarks/relighting_model.py [--model embedded] [--batch 4] [--device auto] [--threads 0] [--precision float32]
"""

import argparse
import json
import time

import torch
from torch.utils.flop_counter import FlopCounterMode

from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.diffusion.relighter import Relighter
from illuminerf.diffusion.sampling import sample_relit
from illuminerf.workflow.device import autocast, resolve_device


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="embedded")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--precision", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument("--threads", type=int, default=0, help="0 keeps PyTorch's own choice")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 4, 8, 16])
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    device = resolve_device(arguments.device)
    model = pretrained_model(arguments.model, device)
    size = model.image_size
    image, cues = torch.rand(arguments.batch, 4, size, size), torch.rand(arguments.batch, 12, size, size)
    image, cues = (x.to(device, memory_format=torch.channels_last) for x in (image, cues))
    with autocast(device, arguments.precision):
        speed = {str(steps): images_per_second(model, image, cues, steps) for steps in arguments.steps}
    result = {
        "model": arguments.model,
        "device": str(device),
        "precision": arguments.precision,
        "threads": torch.get_num_threads(),
        "batch": arguments.batch,
        "size": size,
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "gflop": gflop(model, image[:1], cues[:1]),
        "images_per_second": speed,
    }
    print(json.dumps(result, indent=2))


@torch.inference_mode()
def gflop(model: Relighter, image: torch.Tensor, cues: torch.Tensor) -> dict[str, float]:
    """Multiply-adds counted as two, of the condition (once per image) and of one denoising step."""
    with FlopCounterMode(display=False) as counter:
        condition = model.condition(image, cues)
    once = counter.get_total_flops()
    latent = torch.randn(1, *model.latent_shape(image.shape[-2], image.shape[-1]), device=image.device)
    with FlopCounterMode(display=False) as counter:
        model(latent, torch.zeros(1, dtype=torch.long, device=image.device), condition)
    return {"condition": round(once / 1e9, 3), "step": round(counter.get_total_flops() / 1e9, 3)}


def images_per_second(model: Relighter, image: torch.Tensor, cues: torch.Tensor, steps: int, repeats: int = 3) -> float:
    """Best of `repeats` after one warm-up."""
    seeds = [[index] for index in range(len(image))]
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        sample_relit(model, image, cues, seeds, steps).cpu()
        seconds.append(time.perf_counter() - start)
    return round(len(image) / min(seconds[1:]), 2)


if __name__ == "__main__":
    main()
