"""TensorBoard: event files in RUN_DIR/tensorboard/seed_N, one more each time that a run is resumed.

They are written by tensorboardX's synchronous writer: that of its `SummaryWriter` waits for ever when the disk is full.
"""

import struct
import time
from pathlib import Path

from dgae_jax.run.sinks.sink import Place, Row, Sink, numbers, scores, seeds_of, settings


def begin(place: Place) -> Sink:
    """A new event file per seed; what an older one has of later steps than `place.kept` is hidden by the viewer from then on."""
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.summary import text

    writers = {
        seed: _writer(place.run_dir / "tensorboard" / f"seed_{seed}")
        for seed in seeds_of(place.config)
    }

    def write(seed: int, **event) -> None:
        writers[seed].write_event(Event(wall_time=time.time(), **event))

    def scalars(seed: int, steps: int, values: dict[str, float]) -> None:
        write(
            seed,
            step=steps,
            summary=Summary(
                value=[Summary.Value(tag=name, simple_value=x) for name, x in values.items()]
            ),
        )

    def flush() -> None:
        for writer in writers.values():
            writer.flush()

    def rows(rows: list[Row]) -> None:
        for row in rows:
            scalars(row["seed"], row["steps"], numbers(row))
        flush()

    def evaluations(rows: list[Row]) -> None:
        for row in rows:
            scalars(row["seed"], row["steps"], scores(row))
        flush()

    def close(paths: list[Path], finished: bool) -> None:
        images = [
            Summary.Value(tag=path.name, image=_image(path))
            for path in paths
            if path.suffix == ".png"
        ]
        for seed, writer in writers.items():
            write(seed, summary=Summary(value=images))
            writer.close()

    for seed in writers:
        write(seed, step=place.kept + 1, session_log=SessionLog(status=SessionLog.START))
        write(seed, summary=text("configuration", _table(settings(place.config, seed))))
    flush()
    return Sink(rows, evaluations, close)


def _writer(folder: Path):
    """Of an event file whose name no other has, also within a second."""
    from tensorboardX.event_file_writer import EventsWriter

    folder.mkdir(parents=True, exist_ok=True)
    return EventsWriter(str(folder / "events"), f".{len(list(folder.iterdir()))}")


def _image(path: Path):
    """A PNG as it is, with the size that its header says."""
    from tensorboardX.proto.summary_pb2 import Summary

    data = path.read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    return Summary.Image(width=width, height=height, colorspace=4, encoded_image_string=data)


def _table(values: dict) -> str:
    return "\n".join(
        [
            "| setting | value |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in values.items()),
        ]
    )
