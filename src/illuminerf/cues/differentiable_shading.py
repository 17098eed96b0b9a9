"""Radiance of rays by path tracing, with its gradient by materials and light, for torch.

Mitsuba's path replay backpropagation (Vicini et al. 2021) on rays of our own, so that one batch holds pixels of all
photographs. The gradient is that of an estimate with other random numbers than the value's: the product of both, which
is what the gradient of a squared error needs, then has no bias (with the same numbers, noise would be fitted away).
"""

import importlib
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from illuminerf.cues.mitsuba_scene import WORLD_FROM_ENVMAP, mitsuba_mesh, rows_from_pole_to_pole
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError

_ATTRIBUTES = {"vertex_color": 3, "vertex_roughness": 1, "vertex_metallic": 1}
_LIGHT = "light.data"


def mitsuba_with_gradients(device: str) -> ModuleType:
    """Mitsuba in a variant that differentiates.

    Raises:
        UserError: only the one without gradients runs here.
    """
    mitsuba = load_mitsuba(device)
    if mitsuba.variant().startswith("scalar"):
        raise UserError(
            "inverse rendering needs a path tracer with gradients",
            got=f"Mitsuba's {mitsuba.variant()}",
            wanted="libLLVM 19 or newer, or --device cuda",
            fix="apt install libllvm19 (Debian, Ubuntu), or name a library in DRJIT_LIBLLVM_PATH",
        )
    return mitsuba


class DifferentiableShading:
    """A mesh in a principled material with values per vertex, under a light; `cues.shading` renders the same.

    Args:
        mesh: the object in the world of the rays.
        map_height: rows of the light; it has twice as many columns.
        max_depth: longest path, in edges.
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: only the variant without gradients runs here.
    """

    def __init__(self, mesh: TriangleMesh, map_height: int, max_depth: int, device: str = "auto") -> None:
        self._mi = mi = mitsuba_with_gradients(device)
        self._dr: Any = importlib.import_module("drjit")
        values = {name: np.full((len(mesh.vertices), width), 0.5) for name, width in _ATTRIBUTES.items()}
        sources = [{"type": "mesh_attribute", "name": name} for name in _ATTRIBUTES]
        slots = ("base_color", "roughness", "metallic")
        material = {"type": "principled", **dict(zip(slots, sources, strict=True))}
        shape = mitsuba_mesh(
            mi, "object", mesh.vertices, mesh.faces, {"type": "twosided", "front": material}, mesh.vertex_normals,
            attributes=values,
        )  # fmt: skip
        light = {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ones((map_height, 2 * map_height, 3), np.float32)),
            "to_world": mi.ScalarTransform4f(WORLD_FROM_ENVMAP),
        }
        self._scene: Any = mi.load_dict({"type": "scene", "light": light, "object": shape})
        self._parameters: Any = mi.traverse(self._scene)
        self._integrator: Any = mi.load_dict({"type": "prb", "max_depth": max_depth, "hide_emitters": True})
        names = list(self._parameters.keys())
        self._names = {end: next(n for n in names if n.endswith(end)) for end in (*_ATTRIBUTES, _LIGHT)}
        self._sampler: Any = mi.load_dict({"type": "independent"})
        self._poles = torch.from_numpy(rows_from_pole_to_pole(np.eye(map_height, dtype=np.float32)[..., None])[..., 0])

    def radiance(
        self,
        base_color: Tensor,
        roughness: Tensor,
        metallic: Tensor,
        light: Tensor,
        rays: tuple[Tensor, Tensor],
        samples_per_ray: int,
        seed: int,
    ) -> tuple[Tensor, Tensor]:
        """Linear radiance [rays, 3] toward the origins of `rays`, 0 where they miss, and which hit, bool [rays].

        Args:
            base_color: linear, [vertices, 3] in [0, 1].
            roughness: [vertices] in [0, 1].
            metallic: [vertices] in [0, 1].
            light: linear radiance [map_height, 2 * map_height, 3], in the axes of `EnvironmentMap`.
            rays: origins and unit directions [rays, 3].
            samples_per_ray: paths for each, once for the value and once for the gradient.
            seed: of the paths.
        """
        rows = torch.einsum("hH,Hwc->hwc", self._poles.to(light), light)
        # Mitsuba pads the map by one wrapped column at either side
        padded = torch.cat([rows[:, -1:], rows, rows[:, :1]], 1)
        return _Radiance.apply(base_color, roughness, metallic, padded, self, rays, samples_per_ray, seed)

    def traced(self, rays: tuple[Tensor, Tensor], samples: int, seed: int) -> tuple[Tensor, Tensor]:
        """Radiance and hits with the values that are set."""
        ray, sampler = self._prepared(rays, samples, seed)
        dr = self._dr
        with dr.suspend_grad():
            found, hit, _, _ = self._sampled(dr.ADMode.Primal, sampler, ray, None, None)
            channels = [*found, dr.select(hit, self._mi.Float(1), self._mi.Float(0))]
            # a path of zero probability can give a NaN in single precision; it carries no light
            channels = [
                dr.select(dr.isfinite(c), c, 0) + dr.zeros(self._mi.Float, len(rays[0]) * samples) for c in channels
            ]
            dr.eval(channels)
        means = [np.array(dr.block_sum(c, samples), np.float32) / np.float32(samples) for c in channels]
        return torch.from_numpy(np.stack(means[:3], -1)), torch.from_numpy(means[3] > 0)

    def set_values(self, values: Sequence[Tensor], attached: bool = False) -> list[Any]:
        """Set base colour, roughness, metallic and the padded light; returns them as Mitsuba's arrays, `attached` to
        what follows so that they get a gradient."""
        leaves = []
        for name, value in zip((*_ATTRIBUTES, _LIGHT), values, strict=True):
            array = np.ascontiguousarray(value.detach().cpu().numpy(), np.float32)
            leaf = self._mi.TensorXf(array) if name == _LIGHT else self._mi.Float(array.ravel())
            if attached:
                self._dr.enable_grad(leaf)
            self._parameters[self._names[name]] = leaf
            leaves.append(leaf)
        self._parameters.update()
        return leaves

    def gradients(
        self, values: Sequence[Tensor], by_radiance: Tensor, rays: tuple[Tensor, Tensor], samples: int, seed: int
    ) -> list[Tensor]:
        """Of sum(by_radiance * radiance), by the values of `set_values`."""
        dr, mi = self._dr, self._mi
        leaves = self.set_values(values, attached=True)
        ray, sampler = self._prepared(rays, samples, seed)
        again = sampler.clone()
        weights = self._repeated(mi.Color3f, by_radiance / samples, samples)
        with dr.suspend_grad():
            state = self._sampled(dr.ADMode.Primal, sampler, ray, None, None)[3]
            self._sampled(dr.ADMode.Backward, again, ray, weights, state)
        found = [np.array(dr.grad(leaf), np.float32) for leaf in leaves]
        # a path of zero probability can give a NaN in single precision; it carries no light
        finite = (np.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0) for gradient in found)
        return [torch.from_numpy(g.reshape(v.shape)).to(v) for g, v in zip(finite, values, strict=True)]

    def _prepared(self, rays: tuple[Tensor, Tensor], samples: int, seed: int) -> tuple[Any, Any]:
        mi = self._mi
        sampler = self._sampler.clone()
        # opaque, or the seed is a constant of a kernel that is compiled anew for each
        sampler.seed(self._dr.opaque(mi.UInt32, seed % 2**32), len(rays[0]) * samples)
        origins, toward = rays
        ray = mi.Ray3f(self._repeated(mi.Point3f, origins, samples), self._repeated(mi.Vector3f, toward, samples))
        return ray, sampler

    def _repeated(self, kind: Any, values: Tensor, samples: int) -> Any:
        """Each row of [rays, 3] so many times. Gathered, for an array that came from elsewhere is aligned this way or
        that, and a kernel that reads it is compiled for its alignment."""
        dr, mi = self._dr, self._mi
        flat = mi.Float(np.ascontiguousarray(values.detach().cpu().numpy(), np.float32).ravel())
        # opaque too, or there is one kernel for each number of samples
        return dr.gather(kind, flat, dr.arange(mi.UInt32, len(values) * samples) // dr.opaque(mi.UInt32, samples))

    def _sampled(self, mode: Any, sampler: Any, ray: Any, by_radiance: Any, state: Any) -> Any:
        return self._integrator.sample(
            mode=mode, scene=self._scene, sampler=sampler, ray=ray, δL=by_radiance, δaovs=None, state_in=state,
            active=self._mi.Bool(True),
        )  # fmt: skip


class _Radiance(torch.autograd.Function):
    """`DifferentiableShading.radiance` of a padded light."""

    @staticmethod
    def forward(
        ctx: Any,
        base_color: Tensor,
        roughness: Tensor,
        metallic: Tensor,
        padded: Tensor,
        shading: DifferentiableShading,
        rays: tuple[Tensor, Tensor],
        samples: int,
        seed: int,
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(base_color, roughness, metallic, padded)
        ctx.call = (shading, rays, samples, seed)
        shading.set_values((base_color, roughness, metallic, padded))
        found, hit = shading.traced(rays, samples, derived_seed(seed, "value"))
        ctx.mark_non_differentiable(hit)
        return found.to(base_color.device), hit.to(base_color.device)

    @staticmethod
    def backward(ctx: Any, by_radiance: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        shading, rays, samples, seed = ctx.call
        found = shading.gradients(ctx.saved_tensors, by_radiance, rays, samples, derived_seed(seed, "gradient"))
        return (*found, None, None, None, None)
