"""The page that a browser shows: a scene and its switches, by viser."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable

import numpy as np
import trimesh
import viser
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.mesh.picture import up_direction
from mipsjax.submaps.ids import RecordId
from mipsjax.submaps.state import Pose, Status
from mipsjax.viewer.shown import Image, Shown, ShownMesh, ShownSubmap

Color = tuple[int, int, int]

HOST = "127.0.0.1"
"""Only this machine sees it."""
STATUS_COLORS = {
    Status.OK: (40, 160, 80),
    Status.WEAK: (230, 150, 20),
    Status.LOST: (210, 40, 40),
    Status.SKIPPED: (130, 130, 130),
}
TRUTH_COLOR, KEPT_COLOR, REJECTED_COLOR = (20, 20, 20), (60, 90, 220), (210, 40, 40)
PALETTE = np.array(
    [
        (31, 119, 180),
        (255, 127, 14),
        (44, 160, 44),
        (214, 39, 40),
        (148, 103, 189),
        (140, 86, 75),
        (23, 190, 207),
    ]
)
"""Of submaps, in turn."""
UNKNOWN = (160, 160, 160)
COLORINGS = ("colour", "uncertainty", "submap")
LAYERS = ("mesh", "path", "true path", "camera", "keyframes", "keyframe images", "submaps", "loops")
HIDDEN_AT_FIRST = ("keyframe images",)
FRUSTUM_M, CAMERA_M, PATH_M = 0.06, 0.15, 0.012
OVERVIEW_M = 2.5
"""From where one looks at first: so far behind the path and above it."""
FAR_M = 1000.0
"""A path farther from the origin of the world is drawn around a nearer one."""
MOST_PIECES = 5000
"""Lines that a path is drawn as."""
Node = viser.SceneNodeHandle


class Stage:
    """One page. What is shown again replaces what it showed before."""

    def __init__(self, port: int, on_pause: Callable[[bool], None] | None = None) -> None:
        """Serves it, at the next free port where that one is taken. With `on_pause` it has a button that pauses."""
        # viser prints a table of its own
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            self._server = viser.ViserServer(host=HOST, port=port, label="mipsjax", verbose=False)
        # Pictures, surfaces and switches come from threads of their own
        self._lock = threading.RLock()
        self._mesh: ShownMesh | None = None
        self._images: dict[RecordId, Image] = {}
        self._shown: Shown | None = None
        self._origin, self._looks = np.zeros(3), False
        self._drawn: dict[str, dict[str, Node]] = {layer: {} for layer in LAYERS}
        gui = self._server.gui
        # Its button makes a page public
        gui.configure_theme(show_share_button=False)
        self._text = gui.add_markdown("no frame yet")
        if on_pause is not None:
            self._add_pause(on_pause)
        self._follow = gui.add_checkbox("follow the camera", False)
        self._coloring = gui.add_dropdown("surface by", COLORINGS)
        self._coloring.on_update(lambda _: self._draw_mesh())
        self._switches = {}
        for layer in LAYERS:
            switch = gui.add_checkbox(layer, layer not in HIDDEN_AT_FIRST)
            switch.on_update(lambda _, layer=layer: self._switched(layer))
            self._switches[layer] = switch
        self._last_image: viser.GuiImageHandle | None = None

    @property
    def url(self) -> str:
        """Where a browser finds it."""
        return f"http://{HOST}:{self._server.get_port()}"

    def show(self, picture: Shown) -> None:
        """Everything but the surface."""
        with self._lock:
            if not self._looks:
                self._look_at(picture)
            if picture.T_truth_cam is None and self._shown is not None:
                picture = picture._replace(T_truth_cam=self._shown.T_truth_cam)
            self._images |= picture.images
            self._shown = picture
            self._text.content = picture.text
            with self._server.atomic():
                self._draw_paths(picture)
                self._draw_camera(picture)
                self._draw_submaps(picture)
                self._draw_loops(picture)
            if picture.image is not None:
                self._show_image(picture.image)
            if self._follow.value and known(picture.T_world_cam)[-1:].any():
                self._move_eyes(picture.T_world_cam[-1])

    def show_mesh(self, mesh: ShownMesh) -> None:
        """The surface."""
        with self._lock:
            self._mesh = mesh
            self._draw_mesh()

    def close(self) -> None:
        """Ends the page."""
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            self._server.stop()

    def _look_at(self, picture: Shown) -> None:
        """Where up is, and from where one looks at first. Far from its origin the world is drawn around the path: the
        browser knows single precision alone."""
        poses = picture.T_world_cam[known(picture.T_world_cam)]
        if not len(poses):
            return
        self._looks = True
        up, middle = up_direction(poses), poses[:, :3, 3].mean(axis=0)
        self._origin = np.rint(middle) if np.abs(middle).max() > FAR_M else np.zeros(3)
        self._server.scene.set_up_direction(up)
        # From behind the first camera, and never straight from above
        back = np.cross(up, poses[0][:3, 0])
        self._server.initial_camera.position = middle - self._origin + OVERVIEW_M * (up + back)
        self._server.initial_camera.look_at = middle - self._origin
        self._draw_mesh()

    def _add_pause(self, on_pause: Callable[[bool], None]) -> None:
        button, paused = self._server.gui.add_button("pause"), [False]

        @button.on_click
        def _(_: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            paused[0] = not paused[0]
            button.label = "go on" if paused[0] else "pause"
            on_pause(paused[0])

    def _switched(self, layer: str) -> None:
        with self._lock:
            for node in self._drawn[layer].values():
                node.visible = self._visible(layer)
            if layer == "keyframe images":
                for name, node in self._drawn["keyframes"].items():
                    assert isinstance(node, viser.CameraFrustumHandle)
                    node.image = self._image_of(RecordId(int(name.rsplit("/", 1)[1])))

    def _visible(self, layer: str) -> bool:
        return bool(self._switches[layer].value)

    def _image_of(self, keyframe: RecordId) -> Image | None:
        return self._images.get(keyframe) if self._visible("keyframe images") else None

    def _replace(self, layer: str, nodes: dict[str, Node]) -> None:
        """Draws a layer as these, by their names; what it was drawn as before goes."""
        for name, node in self._drawn[layer].items():
            # One of the same name was replaced by the new one
            if name not in nodes:
                node.remove()
        for node in nodes.values():
            node.visible = self._visible(layer)
        self._drawn[layer] = nodes

    def _draw_mesh(self) -> None:
        with self._lock:
            mesh = self._mesh
            if mesh is None or not len(mesh.faces):
                return self._replace("mesh", {})
            colored = trimesh.Trimesh(
                mesh.vertices - self._origin,
                mesh.faces,
                vertex_colors=colors_of(mesh, self._coloring.value),
                process=False,
            )
            self._replace("mesh", {"/mesh": self._server.scene.add_mesh_trimesh("/mesh", colored)})

    def _draw_paths(self, picture: Shown) -> None:
        colors = np.array([STATUS_COLORS[status] for status in picture.statuses], np.uint8)
        self._draw_lines("path", picture.T_world_cam, colors, PATH_M)
        if picture.T_truth_cam is not None:
            black = np.broadcast_to(np.array(TRUTH_COLOR, np.uint8), (len(picture.T_truth_cam), 3))
            self._draw_lines("true path", picture.T_truth_cam, black, PATH_M / 2)

    def _draw_lines(
        self, layer: str, T_world_cam: Float64[np.ndarray, "N 4 4"], colors: np.ndarray, width_m: float
    ) -> None:
        """A path through the known poses, each piece in the colour of the frame it leads to."""
        there = np.flatnonzero(known(T_world_cam))
        if len(there) < 2:
            return self._replace(layer, {})
        # Of a long one not every frame
        there = there[:: -(-len(there) // MOST_PIECES)]
        points = segments(T_world_cam[there, :3, 3] - self._origin)
        both = np.repeat(colors[there[1:], None], 2, axis=1)
        name = f"/{layer.replace(' ', '_')}"
        node = self._server.scene.add_line_segments(name, points, both, thickness=width_m)
        self._replace(layer, {name: node})

    def _draw_camera(self, picture: Shown) -> None:
        if not known(picture.T_world_cam)[-1:].any():
            return self._replace("camera", {})
        color = STATUS_COLORS[picture.statuses[-1]]
        node = self._frustum("/camera", picture.camera, picture.T_world_cam[-1], color, CAMERA_M)
        self._replace("camera", {"/camera": node})

    def _draw_submaps(self, picture: Shown) -> None:
        boxes, before, frusta = dict[str, Node](), self._drawn["keyframes"], dict[str, Node]()
        for number, submap in enumerate(picture.submaps):
            red, green, blue = map(int, PALETTE[number % len(PALETTE)])
            color = red, green, blue
            boxes[f"/submaps/{number}"] = self._box(number, submap, color, number == picture.active)
            for keyframe, T_world_cam in zip(submap.keyframes, submap.T_world_cam, strict=True):
                name = f"/keyframes/{number}/{keyframe}"
                if name in before:
                    # There are hundreds, of which few move
                    self._move(before[name], T_world_cam)
                    frusta[name] = before[name]
                else:
                    image = self._image_of(keyframe)
                    frusta[name] = self._frustum(name, picture.camera, T_world_cam, color, FRUSTUM_M, image)
        self._replace("submaps", boxes)
        self._replace("keyframes", frusta)

    def _draw_loops(self, picture: Shown) -> None:
        if not len(picture.loops):
            return self._replace("loops", {})
        colors = np.where(picture.kept[:, None], KEPT_COLOR, REJECTED_COLOR).astype(np.uint8)
        points = (picture.loops - self._origin).astype(np.float32)
        both = np.repeat(colors[:, None], 2, axis=1)
        node = self._server.scene.add_line_segments("/loops", points, both, thickness=PATH_M)
        self._replace("loops", {"/loops": node})

    def _box(self, number: int, submap: ShownSubmap, color: Color, active: bool) -> Node:
        lo, hi = submap.box
        middle = np.eye(4)
        middle[:3, 3] = (lo + hi) / 2
        position, wxyz = self._placed(submap.T_world_sub @ middle)
        return self._server.scene.add_box(
            f"/submaps/{number}",
            color,
            tuple(hi - lo),
            wireframe=True,
            opacity=1.0 if active else 0.5,
            position=position,
            wxyz=wxyz,
        )

    def _frustum(
        self,
        name: str,
        camera: Intrinsics,
        T_world_cam: Pose,
        color: Color,
        size_m: float,
        image: Image | None = None,
    ) -> Node:
        position, wxyz = self._placed(T_world_cam)
        return self._server.scene.add_camera_frustum(
            name,
            fov=float(2 * np.arctan(camera.height / (2 * abs(camera.fy)))),
            aspect=camera.width / camera.height,
            scale=size_m,
            color=color,
            image=image,
            position=position,
            wxyz=wxyz,
        )

    def _move(self, node: Node, T_world_cam: Pose) -> None:
        position, wxyz = self._placed(T_world_cam)
        if not (np.allclose(node.position, position) and np.allclose(node.wxyz, wxyz)):
            node.position, node.wxyz = position, wxyz

    def _placed(self, T: Pose) -> tuple[np.ndarray, np.ndarray]:
        """A pose on the page, as position and quaternion, w first."""
        return T[:3, 3] - self._origin, Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)

    def _show_image(self, image: Image) -> None:
        if self._last_image is None:
            self._last_image = self._server.gui.add_image(image, label="last frame")
        else:
            self._last_image.image = image

    def _move_eyes(self, T_world_cam: Pose) -> None:
        """All who look at the page look from a little behind the camera."""
        for client in self._server.get_clients().values():
            client.camera.position = (T_world_cam @ [0.0, -0.3, -0.8, 1.0])[:3] - self._origin
            client.camera.look_at = (T_world_cam @ [0.0, 0.0, 1.0, 1.0])[:3] - self._origin


def colors_of(mesh: ShownMesh, coloring: str) -> UInt8[np.ndarray, "V 3"]:
    """Of the vertices, by one of `COLORINGS`."""
    if coloring == "submap":
        return np.where(mesh.submap[:, None] < 0, UNKNOWN, PALETTE[mesh.submap % len(PALETTE)]).astype(
            np.uint8
        )
    if coloring == "uncertainty":
        known = np.isfinite(mesh.uncertainty)
        if not known.any():
            return np.full((len(mesh.vertices), 3), UNKNOWN, np.uint8)
        low, high = np.percentile(mesh.uncertainty[known], (5, 95))
        share = np.clip((np.nan_to_num(mesh.uncertainty) - low) / max(high - low, 1e-6), 0, 1)[:, None]
        # From green, certain, by yellow to red
        return (255 * np.concatenate([share, 1 - 0.8 * share, 0.2 * (1 - share)], axis=1)).astype(np.uint8)
    return mesh.color


def segments(points: np.ndarray) -> Float32[np.ndarray, "N-1 2 3"]:
    """The lines from each point to the next."""
    return np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)


def known(T_world_cam: Float64[np.ndarray, "N 4 4"]) -> Bool[np.ndarray, " N"]:
    """Which poses are finite."""
    return np.all(np.isfinite(T_world_cam), axis=(1, 2))
