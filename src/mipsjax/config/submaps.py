"""The part of the configuration that concerns several submaps: which governs, refinement, loops, blending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class VolumeConfig:
    """The box that a submap governs, and when another submap takes over."""

    governs: Literal["frustum", "depth", "surface"] = "depth"
    """What of a keyframe the box encloses. `frustum`: the viewing frustum up to `far`, as in the paper; in a small
    room it reaches through walls. `depth`: the same, cut at the measured depth of each pixel. `surface`: measured
    points nearer than `far` only, so that a box has no share of the empty space in front of them."""
    far: float = 5.0
    """Metres, the far clipping plane of the frustum."""
    max_side: float = 7.0
    """Metres; a side of the box grows up to this length."""
    overlap: float = 0.75
    """Where a smaller share of what a keyframe sees is in the box, a new submap begins."""
    hysteresis: float = 0.1
    """Another submap takes over where it holds this much more of the view than the active one (paper: none given).
    Without it two submaps of about the same overlap take turns."""
    support: int = 4
    """Keyframes of the last submap with which a new one is begun, beside its anchor; the paper has the anchor alone."""
    margin: float = 0.1
    """Metres added to the box beyond what a keyframe sees; not in the paper. As the truncation, so that the region
    behind a wall in which its distance is learned belongs to the box."""
    max_submaps: int = 0
    """Submaps at most, which bounds the memory; 0 is no limit. The active one stays so beyond its box, where frames
    are held by the keyframes alone."""


@dataclass(frozen=True)
class BackgroundConfig:
    """Refinement of inactive submaps, in turn."""

    every_frames: int = 4
    """Frames between two refinements; 0 is none. The paper's second process refines all the time."""
    steps: int = 10
    """Of local bundle adjustment on the anchor and random keyframes of the submap."""
    together: int = 1
    """Submaps refined in one call, as soon as so many are inactive; they are spread over devices."""
    executor: Literal["inline", "thread"] = "inline"
    """Where: between frames, or beside them. The results are the same to the bit."""
    rate: float = 0.3
    """Share of the networks' learning rate; 1 is the paper, whose steps are too noisy to improve what is learned."""
    pose_rate: float = 0.0
    """Share of the pose learning rate (see `map.pose_rate_slow`); 1 is the paper."""


@dataclass(frozen=True)
class LoopConfig:
    """Loops between submaps, and finding a lost camera again."""

    enabled: bool = True
    """Off: no loop is closed as the run goes (the paper's ablation "No LC"); `pairs` still move submaps after the last
    frame."""
    relocalise: bool = True
    """A lost camera is looked for in all submaps; not in the paper."""
    patience: int = 60
    """Lost frames in a row after which a new submap is begun, that hangs on nothing until a loop joins it."""
    apart: int = 3
    """Steps between two submaps, along the chain of those begun from each other, from which meeting again counts as a
    loop and may be rejected as false: 3 are four submaps, as in the paper."""
    features: bool = True
    """Loops are also looked for by image features, not only in the box of a submap."""
    candidates: int = 3
    """Keyframes that look most like a frame and are tried."""
    overlap: float = 0.4
    """Least share of a frame's pixels that the other submap must know for a link to it."""
    inliers: float = 0.94
    """Least share of these that must be within `keyframe.error` of its surface. Only what the submap's keyframes
    observed counts: frames that were there had 0.96 to 1, frames that were not 0.81 to 0.93."""
    held: float = 3e-4
    """How firmly the surfaces must hold the frame in every direction (`core/tracking.py: Registration.held`); furnished
    rooms have 1e-3 to 6e-3, a bare corridor 4e-6."""
    drift: float = 0.05
    """Metres of drift for each metre from the anchor that a submap begun from another may hide, and from a shared frame
    to one that is to be linked to a neighbour: ten times what is usual, since a true loop that comes after more drift
    than this would allow is rejected."""
    drift_rotation: float = 0.015
    """Radians, the same."""
    sigma: float = 0.02
    """Metres, of a frame that was registered in a submap, and of one at its anchor. This and the drift are how far a
    frame to be linked to a neighbour may be from where it is expected."""
    sigma_rotation: float = 0.005
    """Radians, the same."""
    fewest_points: int = 200
    """Matched surface points from which a pair of submaps is also held by them; below, by linked poses alone."""
    points_sigma: float = 0.01
    """Metres, of a matched point across the surface."""
    effective_points: float = 20.0
    """Matched points that count as independent: neighbours share their error."""
    tolerance: float = 0.01
    """Metres (or as many times 1 rad) by which a frame's poses in two submaps may differ before the graph is solved,
    which it is for each new loop as well."""


@dataclass(frozen=True)
class CorrespondConfig:
    """Pairs of surface points of two submaps."""

    points: int = 2048
    """Surface points of a submap; fewer are masked, more are thinned out."""
    newton_steps: int = 4
    """From measured points onto the zero level set."""
    match_steps: int = 3
    """From a point to the surface of the other submap; Eq. 19 is one step, which ends up to 2 cm off."""
    max_distance: float = 0.005
    """Metres; a point with a larger distance after these steps is not on the surface."""
    max_entropy: float = 0.8
    """Share of the entropy of an even class distribution; less certain points are left out."""
    min_gradient: float = 0.2
    """Least norm of the gradient on a surface. It is 1 for a true distance, commonly 0.4 to 1 for a classified one
    (core/correspond.py), and about 0 where nothing was learned."""
    max_gradient: float = 3.0
    """Largest such norm: a distance along rays rises faster than that across a slanted surface."""
    max_angle: float = 0.6
    """Radians between the normals of a pair; across a larger angle they are on different surfaces, as the two sides
    of a thin wall are."""


@dataclass(frozen=True)
class BlendConfig:
    """The distance over several submaps (Eq. 1)."""

    entropy_floor: float = 0.3
    """Nats; bounds the weight 1 / h^2 of a certain point. A submap that measured a surface from nearer counts for more,
    by the inverse variance of depth (`sensor`); one that did not measure it counts for nothing."""
