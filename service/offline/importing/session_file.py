"""Writes sessions of imported frames with their mountings, or of the result of a replay."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from drivers.frames import Frame
from service.encoding import LogClock, Message, encode_frame, encode_tf_static
from service.errors import InputError, StorageError, UsageError
from service.geometry.se2 import SE2
from service.recording.mcap_file import McapFile


def refuse_to_overwrite(source: Path, out: Path) -> None:
    """Raises UsageError where writing `out` would destroy `source`, or a file of that folder."""
    try:
        inputs = [source, *source.iterdir()] if source.is_dir() else [source]
        own = out.exists() and any(out.samefile(path) for path in inputs)
    except OSError as error:
        raise InputError(f"cannot read {source}: {error.strerror}") from error
    if own:
        raise UsageError(f"{out} is read and would be overwritten; name another file to write to")


def write_session(
    path: Path,
    frames: Iterable[Frame],
    mountings: Mapping[str, SE2],
    about: Mapping[str, str],
    log_times: bool = False,
) -> None:
    """Write `/tf_static` and the frames, each at its own time.

    frames      in the order in which a mapper is to have them; at least one
    mountings   sensor -> pose_base_sensor
    about       becomes the metadata "import"
    log_times   True: log times are those of arrival; False: those of the stamps, for logs that have no others

    Nothing stays where it fails. Raises StorageError, and what `frames` raises.
    """

    def messages() -> Iterator[Message]:
        clock = LogClock()
        for k, frame in enumerate(frames):
            log_ns = clock.next_ns(frame.arrived_ns if log_times else frame.stamp_ns)
            if k == 0:
                yield encode_tf_static(mountings, log_ns, log_ns)
            yield encode_frame(frame, log_ns=log_ns)

    write_messages(path, messages(), {"import": about})


def write_messages(
    path: Path, messages: Iterable[Message], metadata: Mapping[str, Mapping[str, str]]
) -> None:
    """Write messages as they come, at least one.

    metadata    name -> key -> text

    Nothing stays where it fails. Raises StorageError, and what `messages` raises.
    """
    file = None
    try:
        for message in messages:
            if file is None:
                path.parent.mkdir(parents=True, exist_ok=True)
                file = McapFile(path, message.log_ns)
                for name, values in metadata.items():
                    file.write_metadata(name, values)
            file.write(message)
        if file is None:
            raise ValueError("no message to write")
        file.finish()
    except FileExistsError as error:
        raise StorageError(f"{error.filename} is in the way; is another command writing {path}?") from error
    except OSError as error:
        _leave(file)
        raise StorageError(f"cannot write {path}: {error.strerror}") from error
    except BaseException:
        _leave(file)
        raise


def _leave(file: McapFile | None) -> None:
    if file is not None:
        file.abandon()
        file.active_path.unlink(missing_ok=True)
