"""Recordings of ROS: a bag of ROS 1, or of ROS 2 as a folder or a file; images, their times and their camera.

Depth is that of REP 118: whole millimetres in 16 bits, or metres as 32-bit floats. A frame is of the moment in the
header of its depth image. What is in the messages is read by `data/rosimages.py`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Num, UInt8

from mipsjax.data import rosimages
from mipsjax.data.association import associate, sort_stamps
from mipsjax.data.calibration import MILLIMETRES, Calibration, Options, with_camera_file
from mipsjax.data.images import ImageHeader
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

LAYOUT = "bag"
MARKERS = "a file *.bag, *.mcap or *.db3, or a folder with metadata.yaml"

SUFFIXES = (".bag", ".mcap", ".db3")
_INDEX = "metadata.yaml"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_NANOSECONDS = 1e-9


class Topic(NamedTuple):
    """What a bag holds under one name."""

    name: str
    type: str
    messages: int
    connections: tuple[Connection, ...]

    def __str__(self) -> str:
        return f"{self.name} ({self.type}, {self.messages} messages)"


class Place(NamedTuple):
    """Where a message lies in the bag."""

    connection: Connection
    nanoseconds: int
    """When it was recorded, by which it is found."""
    rank: int = 0
    """Among those of its topic that were recorded then."""


class Images(NamedTuple):
    """The images of a topic in the order of their own time."""

    timestamps: Float64[np.ndarray, "N"]
    """Seconds, of the moment that they show."""
    places: tuple[Place, ...]
    frame: str
    """In which the first was taken."""
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class BagImages:
    """Pairs of a colour and a depth image in a bag, read when asked for; a `FrameSource`."""

    path: Path
    bag: AnyReader = field(repr=False)
    """Open from here on."""
    color_places: tuple[Place, ...] = field(repr=False)
    depth_places: tuple[Place, ...] = field(repr=False)

    def __len__(self) -> int:
        return len(self.depth_places)

    def color(self, position: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        """RGB pixels."""
        message, problem = self._message(self.color_places[position], "color")
        return (None, problem) if message is None else rosimages.color(message)

    def raw_depth(self, position: int) -> tuple[Num[np.ndarray, "H W"] | None, str]:
        """Depth in millimetres. Raises InputError if it is no depth."""
        message, problem = self._message(self.depth_places[position], "depth")
        return (None, problem) if message is None else rosimages.depth(message, self.depth_name(position))

    def color_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        message, _ = self._message(self.color_places[position], "color")
        return None if message is None else rosimages.header(message)

    def depth_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        message, _ = self._message(self.depth_places[position], "depth")
        return None if message is None else rosimages.header(message)

    def depth_name(self, position: int) -> Path:
        """The bag and the topic, for messages."""
        return Path(f"{self.path}: {self.depth_places[position].connection.topic}")

    def files(self, position: int) -> tuple[Path, ...]:
        """Those of all frames."""
        return tuple(sorted(self.path.iterdir())) if self.path.is_dir() else (self.path,)

    def _message(self, place: Place, kind: str) -> tuple[Any, str]:
        """A message, or None and why not."""
        try:
            return _message_at(self.bag, place), ""
        except Exception as error:  # whatever decompression and parsing of a damaged message raise
            return None, f"unreadable_{kind}: {self.path.name}: {_why(error)}"


def matches(path: Path) -> bool:
    """Whether a path looks like this layout."""
    return (path / _INDEX).is_file() or (path.suffix in SUFFIXES and path.is_file())


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a bag. Raises InputError."""
    options = with_camera_file(options, path if path.is_dir() else path.parent)
    bag, topics = _opened(path)
    images = [topic for topic in topics if topic.type in rosimages.TYPES and topic.messages]
    encodings = {topic.name: _encoding(bag, topic) for topic in images}
    depths = [topic for topic in images if rosimages.is_depth(encodings[topic.name], topic.name)]
    colors = [topic for topic in images if encodings[topic.name] in rosimages.COLORED]
    depth = _chosen(path, "depth", topics, images, depths, options.depth_topic)
    color = _chosen(path, "color", topics, images, colors, options.color_topic)
    color_images, depth_images = (_images(path, bag, topic) for topic in (color, depth))
    try:
        of_color, of_depth = associate(color_images.timestamps, depth_images.timestamps)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    notes = (f"depth from {depth.name}, colour from {color.name}", *color_images.notes, *depth_images.notes)
    if max(len(color_images.places), len(depth_images.places)) > len(of_depth):
        counts = f"{len(color_images.places)} colour and {len(depth_images.places)} depth images"
        notes += (f"{len(of_depth)} pairs of {counts}; the others have no partner in time",)
    if color_images.frame != depth_images.frame:
        notes += (
            f"depth is of {depth_images.frame!r} and colour of {color_images.frame!r}: record depth that is aligned to "
            "colour, or colours lie beside their surfaces",
        )
    calibration, camera_notes = options.intrinsics, ()
    if calibration is None:
        calibration, camera_notes = _calibration(path, bag, topics, depth, depth_images.frame)
    return image_sequence(
        name=path.name if path.is_dir() else path.stem,
        layout=LAYOUT,
        source=BagImages(
            path,
            bag,
            tuple(color_images.places[i] for i in of_color),
            tuple(depth_images.places[i] for i in of_depth),
        ),
        timestamps=depth_images.timestamps[of_depth],
        T_world_cam=None,
        calibration=calibration,
        depth_scale=options.depth_scale or MILLIMETRES,
        input=options.input,
        notes=notes + camera_notes,
    )


def _opened(path: Path) -> tuple[AnyReader, tuple[Topic, ...]]:
    """The bag and what is in it. Raises InputError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"{path}: a ROS bag, which takes another package: pip install 'mipsjax[bags]'"
        ) from error
    try:
        # Older bags of ROS 2 do not define their messages; images have not changed since
        bag = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        bag.open()
        topics = tuple(
            Topic(name, about.msgtype or "several types", about.msgcount, tuple(about.connections))
            for name, about in sorted(bag.topics.items())
        )
    except Exception as error:  # whatever parsing of a damaged bag raises
        raise InputError(f"{path}: cannot be read as a ROS bag ({_why(error)})") from error
    return bag, topics


def _message_at(bag: AnyReader, place: Place) -> Any:
    """The message of a place."""
    start = place.nanoseconds
    there = bag.messages([place.connection], start, start + 1)
    connection, _, data = next(islice(there, place.rank, None))
    return bag.deserialize(data, connection.msgtype)


def _first(bag: AnyReader, topic: Topic) -> Any:
    """The first message of a topic that has some."""
    connection, _, data = next(bag.messages(topic.connections))
    return bag.deserialize(data, connection.msgtype)


def _encoding(bag: AnyReader, topic: Topic) -> str:
    """How the images of a topic are stored, by its first one; empty where that cannot be read."""
    try:
        return rosimages.encoding(_first(bag, topic))
    except (
        Exception
    ):  # whatever parsing of a damaged message raises: another topic may be the one that is wanted
        return ""


def _chosen(
    path: Path,
    kind: str,
    topics: Sequence[Topic],
    images: Sequence[Topic],
    candidates: Sequence[Topic],
    wanted: str | None,
) -> Topic:
    """The topic of images that was asked for, or else the only candidate. Raises InputError."""
    option = f"--{kind}-topic"
    if wanted is not None:
        for topic in images:
            if topic.name == wanted:
                return topic
        raise InputError(f"{path}: has no images at {wanted}; {option} names one of {_listed(images)}")
    # The same images, compressed again, lie below the name of the raw ones
    names = {topic.name for topic in candidates}
    own = [topic for topic in candidates if topic.name.rsplit("/", 1)[0] not in names]
    if len(own) == 1:
        return own[0]
    if own:
        raise InputError(f"{path}: several topics of {kind}; {option} names one of {_listed(own)}")
    raise InputError(f"{path}: no topic of {kind} images; {option} names one of {_listed(topics)}")


def _why(error: Exception) -> str:
    """What an exception of the package says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none: the bag is empty"


def _images(path: Path, bag: AnyReader, topic: Topic) -> Images:
    """All images of a topic by their own time. Raises InputError."""
    times, places, frame = [], [], ""
    recorded = Counter[tuple[int, int]]()
    try:
        for connection, nanoseconds, data in bag.messages(topic.connections):
            header = bag.deserialize(data, connection.msgtype).header  # pyright: ignore[reportAttributeAccessIssue]
            own = header.stamp.sec + _NANOSECONDS * header.stamp.nanosec
            # Drivers without a clock leave it zero
            times.append(own or _NANOSECONDS * nanoseconds)
            then = connection.id, nanoseconds
            places.append(Place(connection, nanoseconds, recorded[then]))
            recorded[then] += 1
            frame = frame or header.frame_id
    except Exception as error:  # as above
        problem = f"{topic.name} is read up to a damaged message ({_why(error)})"
        if not times:
            raise InputError(f"{path}: {problem}") from error
    else:
        problem = ""
    order, notes = sort_stamps(np.array(times), topic.name)
    notes += (problem,) if problem else ()
    return Images(np.array(times)[order], tuple(places[i] for i in order), frame, notes)


def _calibration(
    path: Path, bag: AnyReader, topics: Sequence[Topic], depth: Topic, frame: str
) -> tuple[Calibration, tuple[str, ...]]:
    """Intrinsics by the camera info of the frame of the depth images, or else nearest to them in name, and remarks.

    Raises:
        InputError: there is none, or it was never calibrated.
    """
    infos = {}
    for topic in topics:
        if topic.type == _CAMERA_INFO and topic.messages:
            # One that is damaged is none
            with suppress(Exception):
                infos[topic.name] = _first(bag, topic)
    if not infos:
        raise InputError(
            f"{path}: no topic of {_CAMERA_INFO} that can be read; pass --intrinsics FX FY CX CY or put camera.json "
            "beside it"
        )
    nearest = max(
        infos, key=lambda name: (infos[name].header.frame_id == frame, _common_parts(name, depth.name))
    )
    return rosimages.calibration(infos[nearest], nearest, depth.name)


def _common_parts(one: str, other: str) -> int:
    """With how many parts in common two names begin."""
    parts = zip(one.split("/"), other.split("/"), strict=False)
    differ = [a != b for a, b in parts]
    return differ.index(True) if True in differ else len(differ)
