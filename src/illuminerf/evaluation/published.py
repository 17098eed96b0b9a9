"""Figures that others published, to stand beside ours; each with where it is printed.

They are for the whole benchmarks (TensoIR: four scenes, five lights, 200 views each; Stanford-ORB: 14
objects under three lights). Figures of ours over fewer scenes or lights are not comparable with them cell
by cell; GALLERY is.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedScores:
    """One row of a published table: PSNR and SSIM, higher is better, LPIPS, lower is better."""

    method: str
    psnr: float
    ssim: float
    lpips: float
    source: str
    """The publication that prints the row."""
    note: str = ""


@dataclass(frozen=True)
class PublishedOrbScores:
    """One row of the Stanford-ORB relighting table."""

    method: str
    psnr_h: float
    """PSNR of HDR images, in dB."""
    psnr_l: float
    """PSNR of sRGB images, in dB."""
    ssim: float
    lpips: float
    source: str


_ILLUMINERF = "IllumiNeRF, NeurIPS 2024"
_ROGR = "ROGR, 2025"
_RELIGHTABLE_3DGS = "reported by later work on the TensoIR benchmark"

TENSOIR = (
    PublishedScores("ROGR", 30.74, 0.950, 0.069, _ROGR, "128 TPUv5 of training, 8 H100"),
    PublishedScores("IllumiNeRF", 29.709, 0.947, 0.072, _ILLUMINERF, "16 A100 + TPUv5, 0.75 + 1 + 0.75 h"),
    PublishedScores("IllumiNeRF, one GPU", 29.245, 0.946, 0.073, _ILLUMINERF, "A100 + TPUv5, 2 + 1 + 2 h"),
    PublishedScores("Relightable 3D Gaussian", 29.05, 0.937, 0.080, _RELIGHTABLE_3DGS),
    PublishedScores("TensoIR", 28.580, 0.944, 0.081, _ILLUMINERF, "RTX 2080 Ti, 5 h"),
    PublishedScores("Neural Gaffer", 27.30, 0.918, 0.122, _RELIGHTABLE_3DGS),
    PublishedScores("Neural-PBIR", 27.09, 0.925, 0.085, _RELIGHTABLE_3DGS),
    PublishedScores("InvRender", 23.973, 0.901, 0.101, _ILLUMINERF, "RTX 2080 Ti, 15 h"),
    PublishedScores("NeRFactor", 23.383, 0.908, 0.131, _ILLUMINERF, "RTX 2080 Ti, > 100 h"),
)


@dataclass(frozen=True)
class PublishedAblation:
    """One row of the paper's ablation: TensoIR's hotdog, 200 views under each of five lights."""

    num_samples: int
    """Samples per photograph, S."""
    uses_latents: bool
    """False: a standard NeRF."""
    psnr: float
    ssim: float
    lpips: float


ABLATION = (
    PublishedAblation(1, False, 24.957, 0.921, 0.099),
    PublishedAblation(1, True, 26.321, 0.925, 0.097),
    PublishedAblation(4, True, 27.409, 0.936, 0.087),
    PublishedAblation(16, True, 27.950, 0.939, 0.082),
)


def published_ablation(num_samples: int, uses_latents: bool) -> PublishedAblation | None:
    """The paper's row with these settings, where it has one."""
    return next((row for row in ABLATION if (row.num_samples, row.uses_latents) == (num_samples, uses_latents)), None)


STANFORD_ORB = (
    PublishedOrbScores("DiffReg-PBIR", 27.22, 34.98, 0.981, 0.021, "reported by later work on Stanford-ORB"),
    PublishedOrbScores("ROGR", 26.21, 32.91, 0.980, 0.027, _ROGR),
    PublishedOrbScores("Neural-PBIR", 26.01, 33.26, 0.979, 0.023, _ILLUMINERF),
    PublishedOrbScores("IllumiNeRF, one GPU", 25.56, 32.74, 0.976, 0.027, _ILLUMINERF),
    PublishedOrbScores("IllumiNeRF", 25.42, 32.62, 0.976, 0.027, _ILLUMINERF),
    PublishedOrbScores("NVDiffRecMC", 24.43, 31.60, 0.972, 0.036, _ILLUMINERF),
    PublishedOrbScores("InvRender", 23.76, 30.83, 0.970, 0.046, _ILLUMINERF),
    PublishedOrbScores("NeRFactor", 23.54, 30.38, 0.969, 0.048, _ILLUMINERF),
    PublishedOrbScores("NeRD", 23.29, 29.65, 0.957, 0.059, _ILLUMINERF),
    PublishedOrbScores("NVDiffRec", 22.91, 29.72, 0.963, 0.039, _ILLUMINERF),
    PublishedOrbScores("PhySG", 21.81, 28.11, 0.960, 0.055, _ILLUMINERF),
)


@dataclass(frozen=True)
class PublishedStudy:
    """One row of the paper's study of illumination: against renderings of the scanned objects, not photographs."""

    method: str
    illumination: str
    """Under which lights the method relit: one per object and lighting, or that measured for each image."""
    fixed: tuple[float, float, float, float]
    """PSNR-H, PSNR-L, SSIM, LPIPS against references under one light."""
    per_image: tuple[float, float, float, float]
    """Against references under the light of each image."""


ILLUMINATION_STUDY = (
    PublishedStudy("IllumiNeRF, one GPU", "fixed", (26.34, 32.53, 0.974, 0.029), (26.05, 32.17, 0.973, 0.029)),
    PublishedStudy("IllumiNeRF", "fixed", (26.29, 32.45, 0.973, 0.029), (26.00, 32.11, 0.973, 0.029)),
    PublishedStudy("NVDiffRecMC", "per image", (25.17, 31.19, 0.970, 0.037), (25.45, 31.53, 0.970, 0.036)),
    PublishedStudy("InvRender", "per image", (24.50, 30.75, 0.970, 0.047), (24.68, 30.93, 0.971, 0.046)),
    PublishedStudy("NeRFactor", "per image", (24.38, 30.70, 0.970, 0.049), (24.55, 30.85, 0.970, 0.048)),
    PublishedStudy("NeRD", "per image", (24.05, 30.20, 0.968, 0.053), (24.22, 30.36, 0.969, 0.053)),
    PublishedStudy("NVDiffRec", "per image", (23.47, 29.35, 0.960, 0.037), (23.71, 29.60, 0.960, 0.037)),
    PublishedStudy("PhySG", "per image", (22.55, 28.05, 0.959, 0.056), (22.71, 28.19, 0.959, 0.055)),
    PublishedStudy("the photographs", "-", (26.25, 32.69, 0.975, 0.024), (26.73, 33.27, 0.977, 0.023)),
)


@dataclass(frozen=True)
class GalleryScores:
    """PSNR in dB of one scene and light: frames of the paper's gallery videos under this rule, every 20th
    view.
    """

    scene: str
    light: str
    paper: float
    """The paper's renderings."""
    tensoir: float
    """TensoIR's renderings."""
    input_light: float
    """The true view under the input light, rescaled: what not relighting at all scores with perfect
    geometry.
    """


GALLERY = (
    GalleryScores("hotdog", "bridge", 27.28, 25.19, 24.65),
    GalleryScores("hotdog", "city", 25.79, 25.34, 26.66),
    GalleryScores("hotdog", "night", 29.73, 31.70, 25.96),
    GalleryScores("lego", "bridge", 26.74, 27.34, 23.38),
    GalleryScores("lego", "city", 27.33, 23.24, 26.02),
    GalleryScores("lego", "night", 29.49, 29.97, 24.54),
)


def gallery_scores(scene: str, light: str) -> GalleryScores | None:
    """The gallery's figures for one scene and light, where there are any."""
    return next((row for row in GALLERY if (row.scene, row.light) == (scene, light)), None)
