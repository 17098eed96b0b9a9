"""The same object of other stuff: materials exchanged at random."""

import numpy as np

from illuminerf.cues.materials import Material, Parts


def varied(parts: Parts, generator: np.random.Generator) -> Parts:
    """The same object of other stuff: roughness and metallic replaced, base colour tinted or replaced, at random.

    Each of the four changes is drawn on its own, so that shape and material stay independent in small collections.
    """
    new_roughness = float(generator.uniform(0.08, 0.95)) if generator.random() < 0.6 else None
    new_metallic = float(generator.random() < 0.5) if generator.random() < 0.4 else None
    tint = generator.uniform(0.3, 1.0, 3) if generator.random() < 0.5 else None
    flat_color = tuple(generator.uniform(0.02, 0.95, 3)) if generator.random() < 0.25 else None
    return [(mesh, _replaced(material, new_roughness, new_metallic, tint, flat_color)) for mesh, material in parts]


def _replaced(
    material: Material,
    roughness: float | None,
    metallic: float | None,
    tint: np.ndarray | None,
    flat_color: tuple[float, float, float] | None,
) -> Material:
    color = np.asarray(material.base_color, np.float32)
    if flat_color is not None:
        color = np.broadcast_to(np.asarray(flat_color, np.float32), color.shape)
    elif tint is not None:
        color = color * tint.astype(np.float32)
    return Material(
        np.ascontiguousarray(color),
        material.roughness if roughness is None else roughness,
        material.metallic if metallic is None else metallic,
        material.uv,
    )
