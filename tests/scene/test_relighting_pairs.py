"""Items on disk: what comes back is what went in, as far as the format holds it."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.relighting_pairs import decode_item, encode_item, iterate_items
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import sample_tar, write_shard
from illuminerf.workflow.storage import Storage


def arrays(seed: int = 0) -> dict[str, Any]:
    generator = np.random.default_rng(seed)
    alpha = (generator.random((9, 7)) > 0.4) * generator.uniform(0.1, 1, (9, 7))
    random = lambda *shape: (generator.random((*shape, 9, 7)) * alpha).astype(np.float32)  # noqa: E731
    return {
        "targets": 50 * random(3, 3),
        "cues": 50 * random(3, 12),
        "alpha": alpha.astype(np.float32),
        "base_color": random(3),
        "roughness": random(),
        "metallic": random(),
        "normal": random(3) - random(3),
    }


def test_round_trip() -> None:
    before = arrays()
    files = encode_item(**before, metadata={"b": 1, "a": [2]})
    assert files["json"] == b'{"a": [2], "b": 1}'
    after = decode_item(files["safetensors"])
    covered = before["alpha"] > 0.5 / 255
    np.testing.assert_allclose(after["targets"], before["targets"] * covered, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(after["cues"], before["cues"] * covered, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(after["alpha"] / 255, before["alpha"], atol=0.51 / 255)
    np.testing.assert_allclose(after["albedo"] / 255, srgb_from_linear(before["base_color"]) * covered, atol=0.51 / 255)
    np.testing.assert_allclose(after["roughness"] / 255, before["roughness"] * covered, atol=0.51 / 255)
    assert np.abs(after["targets"] - 1.01 * before["targets"]).max() > 0.1
    assert encode_item(**before, metadata={"a": [2], "b": 1}) == files


def test_what_half_floats_cannot_hold_is_clipped() -> None:
    before = arrays()
    before["targets"] = np.full_like(before["targets"], 1e9)
    after = decode_item(encode_item(**before, metadata={})["safetensors"])
    assert after["targets"].max() == np.float16(65504) and np.isfinite(after["targets"]).all()


def test_only_covered_pixels_take_room() -> None:
    before = arrays()
    content = encode_item(**before, metadata={})["safetensors"]
    covered = int((np.rint(before["alpha"] * 255) > 0).sum())
    assert load(content)["cues"].shape == (3, 12, covered)


def sealed(folder: Path, names: tuple[str, ...]) -> Path:
    """Shards of one item each, and a manifest, as the stage leaves them."""
    storage = Storage(folder)
    shards = {}
    for number, name in enumerate(names):
        item = sample_tar(f"cat_{number}", encode_item(**arrays(number), metadata={}))
        shards[name] = {"sha256": write_shard(storage, name, [item], {}).sha256}
    storage.write_json("manifest.json", {"shards": shards})
    storage.write("DONE", (hashlib.sha256(storage.read("manifest.json")).hexdigest() + "\n").encode())
    return folder


def test_a_shard_whose_index_is_damaged_is_not_passed_over(tmp_path: Path) -> None:
    folder = sealed(tmp_path / "pairs", ("pairs-000000", "pairs-000001"))
    assert [key for key, _, _ in iterate_items(folder)] == ["cat_0", "cat_1"]
    index = folder / "pairs-000001.json"
    content = index.read_bytes()
    for spoilt in (content[:-20], content.replace(b'"sha256": "', b'"sha256": "0')):
        index.write_bytes(spoilt)
        with pytest.raises(UserError, match="pairs-000001 is damaged"):
            next(iterate_items(folder))
    index.write_bytes(content)
    (folder / "manifest.json").write_text('{"shards": {}}')
    with pytest.raises(UserError, match=r"manifest\.json is damaged"):
        next(iterate_items(folder))
    (folder / "DONE").unlink()  # a run under way has no say yet
    assert len(list(iterate_items(folder))) == 2


def test_damage_is_explained() -> None:
    content = encode_item(**arrays(), metadata={})["safetensors"]
    with pytest.raises(UserError, match="cat_0 is damaged"):
        decode_item(content[:100], "cat_0")
    tensors = load(content)
    with pytest.raises(UserError, match="lacks 'normal'"):
        decode_item(save({name: tensors[name] for name in tensors if name != "normal"}))
    tensors["cues"] = np.ascontiguousarray(tensors["cues"][..., :-1])
    with pytest.raises(UserError, match="'cues' of the wrong size"):
        decode_item(save(tensors))
