"""The choice of back end never picks what would crash."""

import pytest

from illuminerf.cues import mitsuba_variant
from illuminerf.workflow.errors import UserError


def test_without_a_new_enough_llvm_the_scalar_variant_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_variant, "_llvm_version", lambda library: 15)
    assert mitsuba_variant.find_llvm() is None
    assert mitsuba_variant.choose_variant("auto") == "scalar_rgb"


def test_with_llvm_the_library_is_named_to_drjit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")
    monkeypatch.setattr(mitsuba_variant, "_llvm_version", lambda library: 19 if "19" in library else None)
    assert mitsuba_variant.choose_variant("cpu") == "llvm_ad_rgb"
    assert "19" in mitsuba_variant.os.environ["DRJIT_LIBLLVM_PATH"]


def test_a_missing_library_has_no_version() -> None:
    assert mitsuba_variant._llvm_version("/nowhere/libLLVM.so") is None
    assert mitsuba_variant._llvm_version("libnothing-of-the-kind.so") is None


@pytest.mark.parametrize("traces_rays", [True, False])
def test_a_gpu_is_taken_where_it_traces_rays(monkeypatch: pytest.MonkeyPatch, traces_rays: bool) -> None:
    monkeypatch.setattr(mitsuba_variant, "_gpu_traces_rays", lambda: traces_rays)
    assert (mitsuba_variant.choose_variant("auto") == "cuda_ad_rgb") == traces_rays
    assert mitsuba_variant.choose_variant("cpu") != "cuda_ad_rgb", "the CPU was asked for"


def test_a_gpu_without_optix_traces_no_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_variant.torch.cuda, "is_available", lambda: True)
    for library, traces_rays in (("libc.so.6", True), ("libnothing-of-the-kind.so", False)):
        monkeypatch.setattr(mitsuba_variant, "_OPTIX", library)
        mitsuba_variant._gpu_traces_rays.cache_clear()
        assert mitsuba_variant._gpu_traces_rays() == traces_rays
    mitsuba_variant._gpu_traces_rays.cache_clear()


def test_devices() -> None:
    assert mitsuba_variant.choose_variant("cuda") == "cuda_ad_rgb"
    with pytest.raises(UserError, match="tpu"):
        mitsuba_variant.choose_variant("tpu")
