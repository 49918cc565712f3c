"""What a viewer shows of a moment, as numbers and images alone: it is sent to another process."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float32, Float64, Int, UInt8

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.core.volume import Box
from mipsjax.data.sequence import Frame
from mipsjax.mesh.reconstruct import Blend, reconstruct
from mipsjax.mesh.render import vertex_colors
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.ids import RecordId
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Pose, SlamState, Status, Submap, trajectory, world_pose

IMAGE_WIDTH = 160
"""Of the images of keyframes."""

Image = UInt8[np.ndarray, "h w 3"]


class ShownSubmap(NamedTuple):
    """A submap: its box, and the cameras of its keyframes."""

    T_world_sub: Pose
    box: Box
    keyframes: tuple[RecordId, ...]
    T_world_cam: Float64[np.ndarray, "K 4 4"]


class Shown(NamedTuple):
    """Everything but the surface."""

    camera: Intrinsics
    T_world_cam: Float64[np.ndarray, "N 4 4"]
    """Of all frames so far."""
    statuses: tuple[Status, ...]
    submaps: tuple[ShownSubmap, ...]
    active: int
    loops: Float64[np.ndarray, "L 2 3"]
    """From the frame that closed it to the anchor of the submap that was seen again."""
    kept: Bool[np.ndarray, " L"]
    """Loops that the graph did not reject."""
    images: dict[RecordId, Image]
    """Of keyframes that were not shown before."""
    image: Image | None = None
    """The last frame."""
    T_truth_cam: Float64[np.ndarray, "N 4 4"] | None = None
    """True poses, in the same world; None where they are not known, or were shown before."""
    text: str = ""
    """In a line or two, how it goes."""


class ShownMesh(NamedTuple):
    """A surface in three colourings."""

    vertices: Float64[np.ndarray, "V 3"]
    """Metres, world frame, which may be far from its origin."""
    faces: Int[np.ndarray, "F 3"]
    color: UInt8[np.ndarray, "V 3"]
    uncertainty: Float32[np.ndarray, " V"]
    """Entropy in nats; NaN where it is not known."""
    submap: Int[np.ndarray, " V"]
    """That is trusted most there; -1 where it is not known."""


def shown(
    state: SlamState,
    info: FrameInfo | None = None,
    frame: Frame | None = None,
    known: Collection[RecordId] = (),
) -> Shown:
    """What there is to show of a state; of keyframes in `known` without their images."""
    loops = [
        (world_pose(state, state.records[loop.record])[:3, 3], state.submaps[loop.second].T_world_sub[:3, 3])
        for loop in state.loops
    ]
    images = {
        keyframe.id: small(keyframe.color)
        for submap in state.submaps
        for keyframe in submap.keyframes
        if keyframe.id not in known
    }
    records = state.records[state.first :]
    return Shown(
        camera=state.camera,
        T_world_cam=trajectory(state),
        statuses=tuple(record.status for record in records),
        submaps=tuple(_submap(submap) for submap in state.submaps),
        active=int(state.active),
        loops=np.array(loops).reshape(-1, 2, 3),
        kept=np.array([loop.weight > 0 for loop in state.loops], bool),
        images=images,
        image=None if frame is None or frame.color is None else small(frame.color, 2 * IMAGE_WIDTH),
        text=_text(state, info),
    )


def shown_mesh(state: SlamState, cfg: Config, voxel_m: float) -> ShownMesh:
    """The surface of the map as it is now."""
    return of_mesh(reconstruct(state, cfg, voxel_m), state, cfg)


def of_mesh(mesh: trimesh.Trimesh, state: SlamState | None = None, cfg: Config | None = None) -> ShownMesh:
    """A mesh of `reconstruct`; with the map that it is of, the submap of each vertex is told, too."""
    vertices = np.asarray(mesh.vertices, np.float64)
    submap = np.full(len(vertices), -1)
    if state is not None and cfg is not None and len(vertices):
        submap = Blend(state, cfg, 2 * cfg.mesh.voxel).leading(vertices)
    uncertainty = mesh.vertex_attributes.get("uncertainty", np.full(len(vertices), np.nan))
    return ShownMesh(
        vertices,
        np.asarray(mesh.faces),
        vertex_colors(mesh),
        np.asarray(uncertainty, np.float32),
        submap,
    )


def bare(state: SlamState) -> SlamState:
    """A state with what `shown_mesh` needs of it alone, to be sent: submaps without what they were found and learned
    by."""
    submaps = [
        submap._replace(
            learned=submap.learned._replace(optimizer=()),
            keyframes=tuple(keyframe._replace(features=None, corners=None) for keyframe in submap.keyframes),
        )
        for submap in state.submaps
    ]
    return state._replace(
        submaps=tuple(submaps), records=Records.of([]), corners=(), refinement=None, good=None, doubts=()
    )


def small(color: Image, width: int = IMAGE_WIDTH) -> Image:
    """An image of at most that width."""
    if color.shape[1] <= width:
        return color
    height = round(color.shape[0] * width / color.shape[1])
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)


def _submap(submap: Submap) -> ShownSubmap:
    poses = [submap.T_world_sub @ keyframe.T_sub_cam for keyframe in submap.keyframes]
    ids = tuple(keyframe.id for keyframe in submap.keyframes)
    return ShownSubmap(submap.T_world_sub, submap.box, ids, np.stack(poses))


def _text(state: SlamState, info: FrameInfo | None) -> str:
    newest = state.records[-1]
    kept = sum(loop.weight > 0 for loop in state.loops)
    lines = [
        f"frame {newest.frame}: **{newest.status}**",
        f"{len(state.submaps)} submaps, {kept} loops",
    ]
    if info is not None:
        lines.append(f"may be {100 * info.world_deviation_m:.1f} cm off")
        lines += [info.note] if info.note else []
    return "  \n".join(lines)
