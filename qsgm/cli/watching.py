"""`qsgm watch`: objects looked for in frame after frame."""

import time
from collections import deque
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qsgm.cli.console import check_output, print_json
from qsgm.cli.options import AnyDistanceOption, ObjectsOption, ThreadsOption
from qsgm.cli.streams import complain
from qsgm.errors import QsgmError, as_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from qsgm.grasp.watch import Watched

app = typer.Typer()
_REMEMBERED = 10_000  # latencies: a camera may run for weeks


@app.command()
def watch(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="A camera's number, a video file, a picture, or a folder or 'glob' of pictures.",
        ),
    ],
    tuned: ObjectsOption = None,
    every: Annotated[int, typer.Option(min=1, help="Look at one frame in so many.")] = 1,
    limit: Annotated[int | None, typer.Option(min=1, help="At so many frames at most.")] = None,
    any_distance: AnyDistanceOption = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE.avi", help="Write an annotated video."),
    ] = None,
    threads: ThreadsOption = 1,
) -> None:
    """Look for tuned objects in frame after frame, one JSON line each.

    Ends with the stream, at --limit, or when it is interrupted; the video then holds what was seen
    until there. How fast it went is said on stderr. Cameras are read through OpenCV and were
    never tried: there was none.
    """
    from qsgm.grasp.watch import check_video_name, new_video, open_stream
    from qsgm.grasp.watch import watch as watched
    from qsgm.store import load_objects

    if output is not None:
        check_video_name(output)
        check_output(output, Path(source))
    objects = load_objects(tuned or (), threads)
    stream = open_stream(source, every)
    video = nullcontext() if output is None else new_video(output, stream.rate)
    with video as write:
        seen = watched(stream, objects, limit=limit, any_distance=any_distance)
        ended = _follow(seen, write)
    if output is not None:
        complain(f"video: {as_text(str(output), 5000)}")
    if ended is not None:
        raise ended


def _follow(
    watched: "Iterator[Watched]", write: "Callable[..., bool] | None"
) -> BaseException | None:
    """Print and draw what is seen; what ended it, if that was not the stream.

    An interrupt, or a reader of stdout that goes away, is how watching a camera ends; a disk that
    its lines fill ends it, too. Where nothing was seen before, it is raised.
    """
    latencies: deque[float] = deque(maxlen=_REMEMBERED)
    frames, start = 0, time.monotonic()
    ended: BaseException | None = None
    try:
        for seen in watched:
            latencies.append(seen.latency_ms)
            frames += 1
            try:
                print_json(seen.to_json())
            except (QsgmError, SystemExit) as error:  # what was seen is kept
                ended = error
            if write is not None and not write(seen.picture()):
                complain("note: the video is as large as AVI allows, so watching ends")
                break
            if ended is not None:
                break
            del seen  # else its frame was kept while the next one is decoded
    except KeyboardInterrupt as error:
        if frames == 0:
            raise
        ended = error
    complain(_summary(frames, time.monotonic() - start, latencies))
    return ended


def _summary(frames: int, seconds: float, latencies: deque[float]) -> str:
    import numpy as np

    middle, high = np.percentile(latencies, (50, 95)) if latencies else (0.0, 0.0)
    return (
        f"{frames} frames in {seconds:.1f} s: {frames / max(seconds, 1e-9):.1f} frames/s; latency "
        f"{middle:.0f} ms median, {high:.0f} ms at the 95th percentile"
    )
