"""Break what deploy/native reads: bundles, sheets, graphs, objects and frames, always the same way.

`python tests/deploy/native_inputs.py PROGRAM MATERIAL SEED COUNT` tries so many and prints counts;
PROGRAM is best built with sanitizers. MATERIAL holds `bundle`, `object` and `frame.ppm`.
"""

import hashlib
import json
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

BUNDLE, OBJECT, FRAME = "bundle", "object", "frame.ppm"
EXTREMES = [b"0", b"-1", b"1", b"255", b"65535", b"99999999999999999999", b"1e308", b"nan", b"-inf"]
EXTREMES += [b"", b" ", b"\0", b"\n", b"#", b"../x", b'"']
SECONDS = 300


def broken(data: bytes, rng: random.Random) -> bytes:
    """One to four things done to a file; in half of them only bits and numbers change."""
    spoiled = bytearray(data)
    ways = range(2 if rng.randrange(2) else 6)  # what is cut or moved is seldom read far
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(spoiled) + 1)
        more = rng.randint(1, 40)
        match rng.choice(ways):
            case 0 if at < len(spoiled):
                spoiled[at] ^= 1 << rng.randrange(8)
            case 1:
                numbers = [*re.finditer(rb"[0-9.]+", bytes(spoiled[:4000]))]
                if numbers:
                    start, end = rng.choice(numbers).span()
                    spoiled[start:end] = rng.choice(EXTREMES)
            case 2:
                spoiled[at : at + more] = rng.randbytes(rng.randint(0, 40))
            case 3:
                del spoiled[at:]
            case 4:
                spoiled[at:at] = spoiled[at : at + more]
            case 5:
                lines = bytes(spoiled).split(b"\n")
                moved = lines.pop(rng.randrange(len(lines)))
                lines[rng.randrange(len(lines) + 1) :][:0] = [moved] * rng.randint(0, 2)
                spoiled = bytearray(b"\n".join(lines))
    return bytes(spoiled)


def spoil(folder: Path, rng: random.Random) -> list[str]:
    """Break one file; the command that reads it. Hashes are mended, so that it is looked into."""
    bundle, known, frame = folder / BUNDLE, folder / OBJECT, folder / FRAME
    teach = ["finetune", "--epochs", "1", str(bundle), str(frame), str(folder / "new")]
    look = ["predict", str(known), str(frame)]
    kind = rng.choice(
        ["text", "text", "sheet", "graph", "about", "network", "frame", "frame", "raw"]
    )
    if kind == "text":
        path, command = bundle / "bundle.txt", teach
    elif kind == "sheet":
        path, command = bundle / "distractors.png", teach
    elif kind == "graph":
        path, command = rng.choice(sorted(bundle.glob("*.onnx"))), teach
    elif kind == "about":
        path, command = known / "object.json", look
    elif kind == "network":
        path, command = known / "network.onnx", look
    else:
        path, command = frame, look
    before = path.read_bytes()
    after = broken(before, rng)
    path.write_bytes(after)
    if kind == "raw":
        command = [
            *look,
            "--raw",
            rng.choice(["128x128", "0x0", "4096x4096", "99999x1", "x", "-1x5"]),
        ]
    listing = path.parent / ("bundle.txt" if path.parent == bundle else "object.json")
    if kind in ("sheet", "graph", "network"):
        old, new = (hashlib.sha256(one).hexdigest() for one in (before, after))
        listing.write_text(listing.read_text().replace(old, new))
    return command


def outcome(program: str, command: list[str], folder: Path) -> str:
    """Whether it was accepted or refused; anything else ends the campaign."""
    try:
        done = subprocess.run(
            [str(Path(program).resolve()), *command],
            capture_output=True,
            check=False,
            timeout=SECONDS,
            cwd=folder,
        )
    except subprocess.TimeoutExpired:
        raise SystemExit(f"{command} takes longer than {SECONDS} s") from None
    said = done.stderr.decode("utf-8", "replace").splitlines()
    if done.returncode == 0 and not said:
        return "accepted"
    if done.returncode == 1 and len(said) == 1 and said[0].startswith("error: "):
        if (folder / "new").exists():
            raise SystemExit(f"{command} was refused and wrote something: {said}")
        return "refused"
    raise SystemExit(f"{command} ended with {done.returncode}: {said[-40:]}")


def main(program: str, material: str, seed: int, count: int) -> None:
    """Try so many inputs; what fails stays in the working folder."""
    counts = Counter[str]()
    for number in range(count):
        rng = random.Random(f"{seed} {number}")
        folder = Path(tempfile.mkdtemp(prefix="native-"))
        for name in (BUNDLE, OBJECT):
            shutil.copytree(Path(material) / name, folder / name)
        shutil.copy(Path(material) / FRAME, folder / FRAME)
        command = spoil(folder, rng)
        counts[outcome(program, command, folder)] += 1
        shutil.rmtree(folder)
        if number % 100 == 99 or number + 1 == count:
            sys.stdout.write(json.dumps({"inputs": number + 1, **counts}) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
