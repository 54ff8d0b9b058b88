"""What several tests of grasping use."""

from pathlib import Path

import pytest
from toy_objects import MUG

from qsgm.bundle import Bundle
from qsgm.grasp.tuned import save_object


@pytest.fixture
def saved(bundle: Bundle, tmp_path: Path) -> Path:
    save_object(tmp_path / "mug", MUG, bundle.network_with({}), {"seed": 3})
    return tmp_path / "mug"
