"""Opens recordings by what is in their files: MCAP, bags of ROS 1, db3 of ROS 2, plain or packed."""

import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from service.errors import InputError
from service.limits import MAX_YAML_BYTES
from service.readable import read_text, refuse_unreadable
from service.recording.bag_reader import Bag
from service.recording.mcap_reader import Readable, Recording
from service.recording.unpacking import MCAP, Unpacked

METADATA = "metadata.yaml"  # which the folder of a ROS 2 bag has
CONTAINERS = ("mcap", "bag", "db3")
PACKED = ("zstd", "zst", "gz", "bz2", "xz", "lz4")
_ENDS = rf"({'|'.join(CONTAINERS)})(\.({'|'.join(PACKED)}))?|bag\.active"  # the last: rosbag was killed
_RECORDING = re.compile(rf"(.+?)\.({_ENDS})")
EXPECTED = (
    f"expected {', '.join(f'*.{suffix}' for suffix in CONTAINERS)}, plain or packed (.{', .'.join(PACKED)}), "
    f"or folders with {METADATA} of ROS 2"
)


def is_recording(path: Path) -> bool:
    """Whether it has the name, or is the folder, of a recording that can be opened."""
    return (path / METADATA).is_file() or (not path.is_dir() and bool(_RECORDING.fullmatch(path.name)))


def name_of(path: Path) -> str:
    """A recording's name without the suffix of its container: "drive" of drive/ and of drive.db3.zstd."""
    if path.is_dir():
        return path.resolve().name
    match = _RECORDING.fullmatch(path.name)
    return match[1] if match else path.stem


def recordings_in(folder: Path) -> list[Path]:
    """Files of recordings, and folders of ROS 2 bags, in a folder that is none itself; a file that lies there
    packed, too, once. Raises InputError where there are none.
    """
    found = [path for path in sorted(folder.iterdir()) if is_recording(path)]
    plain = {path.name for path in found}
    found = [path for path in found if path.suffix[1:] not in PACKED or path.stem not in plain]
    if not found:
        raise InputError(f"{folder}: no recording in this folder; {EXPECTED}")
    return found


def open_recording(paths: Sequence[Path]) -> Readable:
    """Files of one recording, or folders of them, as one stream of messages.

    Raises InputError for what is missing, no recording, unfinished or broken, StorageError where there is no
    place to unpack it.
    """
    files = [Unpacked(file) for path in paths for file in _files(path)]
    kinds = {file.kind for file in files}
    if "" in kinds:
        odd = next(file for file in files if not file.kind)
        raise InputError(f"{odd.given} is no recording: {odd.beginning}; {EXPECTED}")
    if len(kinds) > 1:
        raise InputError(
            f"{' and '.join(map(str, paths))}: files of {' and '.join(sorted(kinds))} are not one recording; "
            "give them apart"
        )
    recording = Recording(files) if kinds == {MCAP} else Bag(files)
    recording.losses += [loss for path in paths for loss in _unlisted(path)]
    return recording


def _files(path: Path) -> list[Path]:
    refuse_unreadable(path)
    if not path.is_dir():
        return [path]
    listed = _listed(path / METADATA)
    if not listed:
        return [file for found in recordings_in(path) for file in _files(found)]
    if missing := [file.name for file in listed if not file.is_file()]:
        raise InputError(f"{path}: {' and '.join(missing)} of its {METADATA} is not there")
    return listed


def _unlisted(path: Path) -> list[str]:
    """Recordings that lie in the folder of a ROS 2 bag and are not read; a listed one may lie there packed
    and unpacked.
    """
    listed = [file.name for file in _listed(path / METADATA)] if path.is_dir() else []
    read = {file.name for file in _files(path)} | {Path(name).stem for name in listed}
    left = [found.name for found in sorted(path.iterdir()) if is_recording(found)] if listed else []
    left = [name for name in left if name not in read and Path(name).stem not in read]
    return [f"{path}: {METADATA} does not list {' and '.join(left)}; not read"] if left else []


def _listed(metadata: Path) -> list[Path]:
    """The files of a ROS 2 bag; none without usable metadata."""
    try:
        about = yaml.safe_load(read_text(metadata, limit=MAX_YAML_BYTES))
        names = about["rosbag2_bagfile_information"]["relative_file_paths"]
        return [metadata.parent / Path(name).name for name in names]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        return []
