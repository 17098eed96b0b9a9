"""A seeded sample of faults: started again, a run ends with the same bytes or says what is damaged.

`benchmarks/faults.py` tries hundreds, over all stages; here it is the one that no threads of earlier tests can disturb.
"""

from unittest import mock

import pytest

from illuminerf.workflow import artefact
from tests.faults.trials import TRIAL_KINDS, Trial, World


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("faults"), ("capture",))


@pytest.mark.parametrize("kind", TRIAL_KINDS)
def test_started_again_it_ends_alike_or_names_the_damage(kind: str, world: World) -> None:
    for seed in range(2):
        verdict = world.attempt(Trial("capture", kind, seed))  # type: ignore[arg-type]
        assert verdict.verdict in ("same", "named"), verdict.detail


def test_without_checksums_a_flipped_bit_goes_unseen(world: World) -> None:
    """Guard: the harness tells a silent difference from the rest."""
    trials = [Trial("capture", "flip", seed) for seed in range(12)]
    with mock.patch.object(artefact, "verify_once", lambda _: None):
        assert "silent" in {world.attempt(trial).verdict for trial in trials}
