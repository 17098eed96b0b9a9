"""A seeded sample of faults: started again, a run ends with the same bytes or says what is damaged.

`benchmarks/faults.py` tries hundreds, over all stages.
"""

import pytest

from tests.faults.trials import World

_NAMES = ("capture", "cues", "views")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("faults"), _NAMES)
