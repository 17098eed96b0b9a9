"""Directions: their encoding and their reflection."""

import torch
from jaxtyping import Float
from torch import Tensor


def encoded_width(num_octaves: int) -> int:
    """Length of an encoded direction."""
    return 3 + 6 * num_octaves


def encode_directions(directions: Float[Tensor, "*batch 3"], num_octaves: int) -> Float[Tensor, "*batch encoded"]:
    """The direction itself, then sine and cosine of its coordinates at frequencies 1, 2, 4, ... (one per octave).

    Higher octaves come from the lower by the double-angle formulas, which costs two products instead of two
    transcendental functions.
    """
    parts = [directions]
    sine, cosine = directions.sin(), directions.cos()
    for octave in range(num_octaves):
        parts += [sine, cosine]
        if octave + 1 < num_octaves:
            sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
    return torch.cat(parts, -1)


def reflect(directions: Float[Tensor, "*batch 3"], normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The mirror direction in which light leaves the surface when followed along `directions` (towards it)."""
    return directions - 2 * (directions * normals).sum(-1, keepdim=True) * normals
