"""Scripts beside the package run, and say what they should."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from toys import lay, table, toy

SCRIPTS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Two objects, each photographed twice, and something else."""
    objects = []
    for number, picture in enumerate((toy(), toy()[..., [1, 2, 0, 3]])):
        photos = []
        for k, center in enumerate(((160.0, 120.0), (150.0, 140.0))):
            file = f"{number}_{k}.png"
            scene = lay(picture, table(k, (240, 320)), center, 30 * k)
            cv2.imwrite(str(tmp_path / file), scene)
            photos.append(
                {"file": file, "center_px": center, "long_side_px": 90, "turn_deg": 30 * k}
            )
        objects.append({"object": f"toy_{number}", "photos": photos})
    cv2.imwrite(str(tmp_path / "nothing.png"), table(7, (240, 320)))
    (tmp_path / "manifest.json").write_text(json.dumps(objects))
    (tmp_path / "negatives.json").write_text(json.dumps(["nothing.png"]))
    return tmp_path


def test_photographs_are_counted_with_the_object_and_without_it(photographs: Path) -> None:
    told = photographs / "told.json"
    bundle = SCRIPTS.parent / "export"
    command = [sys.executable, SCRIPTS / "photographs.py", photographs, "--json", told]
    done = subprocess.run(
        [*map(str, command), "--bundle", str(bundle), "--others", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "found in the right place" in done.stdout
    values = json.loads(told.read_text())
    assert values["refused"] == []
    present = [one for one in values["answers"] if one["present"]]
    absent = [one for one in values["answers"] if not one["present"]]
    assert (len(present), len(absent)) == (2, 2 * (2 + 1))
    for one in present:
        assert one["right"]
        assert one["turn_error_deg"] < 2
    assert not any(one["found"] for one in absent if one["file"] == "nothing.png")
